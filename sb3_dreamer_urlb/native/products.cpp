// The gradient of weights: leftᵀ · right, where both have many more rows than columns, on a processor's tiles (AMX).
//
// A tile holds 16 rows of 32 numbers. One instruction multiplies a tile of the left operand with one of the right, whose
// numbers must lie in pairs of rows, and adds the result to a tile of 16×16 sums in float32. Both operands are laid out that
// way a block of rows at a time, and each block's product is added to all sums.

#include "vectors.h"

#include <sys/syscall.h>
#include <unistd.h>

#include <vector>

constexpr Index TILE = 16, DEPTH = 32, BLOCK = 512;  // numbers a side of a tile of sums, rows that a tile multiplies, rows laid out

static inline Index up_to(Index x, Index multiple) { return (x + multiple - 1) / multiple * multiple; }

#if defined(__AMX_TILE__) && defined(__AMX_BF16__)

using Laid = std::vector<uint16_t>;

// Rows 2j and 2j + 1 of 16 columns as one row of pairs.
static inline __m512i pair(const BF16* first, const BF16* second, __mmask16 columns) {
    __m512i low = _mm512_cvtepu16_epi32(first ? _mm256_maskz_loadu_epi16(columns, first) : _mm256_setzero_si256());
    __m512i high = _mm512_cvtepu16_epi32(second ? _mm256_maskz_loadu_epi16(columns, second) : _mm256_setzero_si256());
    return _mm512_or_si512(low, _mm512_slli_epi32(high, 16));
}

// 16×16 numbers of 32 bits.
static inline void transpose(__m512i x[16]) {
    __m512i y[16];
    for (int i = 0; i < 16; i += 2) {
        y[i] = _mm512_unpacklo_epi32(x[i], x[i + 1]);
        y[i + 1] = _mm512_unpackhi_epi32(x[i], x[i + 1]);
    }
    for (int i = 0; i < 16; i += 4) {
        for (int j = 0; j < 2; j++) {
            x[i + 2 * j] = _mm512_unpacklo_epi64(y[i + j], y[i + j + 2]);
            x[i + 2 * j + 1] = _mm512_unpackhi_epi64(y[i + j], y[i + j + 2]);
        }
    }
    for (int i = 0; i < 4; i++) {
        for (int half = 0; half < 2; half++) {
            y[i + 8 * half] = _mm512_shuffle_i32x4(x[i + 8 * half], x[i + 8 * half + 4], 0x88);
            y[i + 8 * half + 4] = _mm512_shuffle_i32x4(x[i + 8 * half], x[i + 8 * half + 4], 0xdd);
        }
    }
    for (int i = 0; i < 8; i++) {
        x[i] = _mm512_shuffle_i32x4(y[i], y[i + 8], 0x88);
        x[i + 8] = _mm512_shuffle_i32x4(y[i], y[i + 8], 0xdd);
    }
}

// rows × columns of x → tiles, those of 32 rows and the same 16 columns next to those of the next 32 rows.
static void lay_out(const BF16* x, Index stride, Index rows, Index columns, bool transposed, uint16_t* out) {
    const Index steps = up_to(rows, DEPTH) / DEPTH;
    for (Index c = 0; c < up_to(columns, 2 * TILE); c += TILE) {
        const Index left = columns - c;
        const __mmask16 mask = left >= TILE ? 0xffff : left > 0 ? (1 << left) - 1 : 0;
        for (Index s = 0; s < steps; s++, out += TILE * DEPTH) {
            __m512i tile[TILE];
            for (Index j = 0; j < TILE; j++) {
                const Index r = s * DEPTH + 2 * j;
                const BF16* row = x + r * stride + c;
                tile[j] = pair(r < rows ? row : nullptr, r + 1 < rows ? row + stride : nullptr, mask);
            }
            if (transposed) transpose(tile);
            for (Index j = 0; j < TILE; j++) _mm512_storeu_si512(out + j * DEPTH, tile[j]);
        }
    }
}

struct alignas(64) TileShapes {
    uint8_t palette = 1, start_row = 0, reserved[14] = {};
    uint16_t row_bytes[16] = {64, 64, 64, 64, 64, 64, 64, 64};
    uint8_t rows[16] = {16, 16, 16, 16, 16, 16, 16, 16};
};

// Tiles belong to everybody in a thread: whoever used them before finds them as they were.
class Tiles {
    alignas(64) uint8_t before[64];

  public:
    Tiles() {
        static const TileShapes shapes;
        _tile_storeconfig(before);
        _tile_loadconfig(&shapes);
    }
    ~Tiles() { _tile_loadconfig(before); }
};

// sums (M, N) += leftᵀ · right for laid out operands of some rows; M and N are multiples of 32.
static void add_product(const uint16_t* left, const uint16_t* right, float* sums, Index m, Index n, Index rows) {
    const Index steps = up_to(rows, DEPTH) / DEPTH, column = steps * TILE * DEPTH, bytes = n * sizeof(float);
    for (Index i = 0; i < m / TILE; i += 2) {
        for (Index j = 0; j < n / TILE; j += 2) {
            float* c = sums + (i * n + j) * TILE;
            _tile_loadd(0, c, bytes);
            _tile_loadd(1, c + TILE, bytes);
            _tile_loadd(2, c + TILE * n, bytes);
            _tile_loadd(3, c + TILE * n + TILE, bytes);
            const uint16_t *a = left + i * column, *b = right + j * column;
            for (Index s = 0; s < steps; s++, a += TILE * DEPTH, b += TILE * DEPTH) {
                _tile_loadd(4, a, 64);
                _tile_loadd(6, b, 64);
                _tile_dpbf16ps(0, 4, 6);
                _tile_loadd(7, b + column, 64);
                _tile_dpbf16ps(1, 4, 7);
                _tile_loadd(5, a + column, 64);
                _tile_dpbf16ps(2, 5, 6);
                _tile_dpbf16ps(3, 5, 7);
            }
            _tile_stored(0, c, bytes);
            _tile_stored(1, c + TILE, bytes);
            _tile_stored(2, c + TILE * n, bytes);
            _tile_stored(3, c + TILE * n + TILE, bytes);
        }
    }
}

EXPORT int has_tiles() {
    const long REQUEST = 0x1023, TILE_DATA = 18;  // ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA
    return syscall(SYS_arch_prctl, REQUEST, TILE_DATA) == 0;
}

// out (m, n) ← leftᵀ · right; left (rows, m), right (rows, n), their rows `stride` numbers apart. sums: (threads, M, N) of
// zeros, M and N the next multiples of 32.
EXPORT void transposed_product(const BF16* left, Index left_stride, const BF16* right, Index right_stride, float* sums, float* out,
                               Index rows, Index m, Index n, int threads) {
    const Index wide_m = up_to(m, 2 * TILE), wide_n = up_to(n, 2 * TILE);
#pragma omp parallel num_threads(threads)
    {
        const Index me = omp_get_thread_num(), us = omp_get_num_threads();
        const Index share = up_to((rows + us - 1) / us, DEPTH), begin = share * me, end = begin + share < rows ? begin + share : rows;
        float* mine = sums + me * wide_m * wide_n;
        if (begin < end) {
            const Index blocks = (end - begin + BLOCK - 1) / BLOCK, size = up_to((end - begin + blocks - 1) / blocks, DEPTH);
            static thread_local Laid laid_left, laid_right;
            laid_left.resize(wide_m * size), laid_right.resize(wide_n * size);
            Tiles tiles;
            for (Index r = begin; r < end; r += size) {
                const Index count = end - r < size ? end - r : size;
                lay_out(left + r * left_stride, left_stride, count, m, true, laid_left.data());
                lay_out(right + r * right_stride, right_stride, count, n, false, laid_right.data());
                add_product(laid_left.data(), laid_right.data(), mine, wide_m, wide_n, count);
            }
        }
#pragma omp barrier
#pragma omp for schedule(static)
        for (Index i = 0; i < m; i++) {
            for (Index j = 0; j < n; j++) {
                float total = 0;
                for (Index t = 0; t < us; t++) total += sums[(t * wide_m + i) * wide_n + j];
                out[i * n + j] = total;
            }
        }
    }
}

#else

EXPORT int has_tiles() { return 0; }
EXPORT void transposed_product(const BF16*, Index, const BF16*, Index, float*, float*, Index, Index, Index, int) {}

#endif
