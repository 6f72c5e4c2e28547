// A processor's tiles (AMX): matrices of 16 rows of 32 bfloat16 numbers. One instruction multiplies a tile of the left operand
// with one of the right and adds the product to a tile of 16×16 sums in float32. The right operand's numbers must lie in pairs:
// its row j holds those of depth 2j and 2j + 1, by turns.
//
// Operands are laid out in panels of 32 rows (left) or columns (right): two tiles for each 32 numbers of depth, one step. A
// float32 number is the sum of three bfloat16 numbers; laid out as three parts, six products of parts give the product of the
// numbers as exactly as float32 does (the three left out are below its rounding).
#pragma once

#if defined(__AMX_TILE__) && defined(__AMX_BF16__) && defined(__AVX512BF16__) && defined(__AVX512BW__)
#define HAS_TILES 1

#include <cstdlib>

#include "vectors.h"

constexpr Index TILE = 16, PANEL = 2 * TILE, DEPTH = 32, NUMBERS = TILE * DEPTH;

static inline Index up_to(Index x, Index multiple) { return (x + multiple - 1) / multiple * multiple; }
static inline Index steps_of(Index depth) { return (depth + DEPTH - 1) / DEPTH; }
static inline Index least(Index a, Index b) { return a < b ? a : b; }

template <class T>
constexpr int PARTS = 1;
template <>
constexpr int PARTS<float> = 3;

// Numbers of an operand laid out.
template <class T>
static inline Index laid_size(Index across, Index depth) {
    return up_to(across, PANEL) * steps_of(depth) * DEPTH * PARTS<T>;
}

struct alignas(64) TileShapes {
    uint8_t palette = 1, start_row = 0, reserved[14] = {};
    uint16_t row_bytes[16] = {64, 64, 64, 64, 64, 64, 64, 64};
    uint8_t rows[16] = {16, 16, 16, 16, 16, 16, 16, 16};
};

// Tiles belong to everybody in a thread: whoever shaped them before finds them so.
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
        for (int half = 0; half < 16; half += 8) {
            y[i + half] = _mm512_shuffle_i32x4(x[i + half], x[i + half + 4], 0x88);
            y[i + half + 4] = _mm512_shuffle_i32x4(x[i + half], x[i + half + 4], 0xdd);
        }
    }
    for (int i = 0; i < 8; i++) {
        x[i] = _mm512_shuffle_i32x4(y[i], y[i + 8], 0x88);
        x[i + 8] = _mm512_shuffle_i32x4(y[i], y[i + 8], 0xdd);
    }
}

static inline __mmask32 first(Index count) { return count >= 32 ? ~0u : count <= 0 ? 0 : (1u << count) - 1; }

// 32 numbers as parts.
static inline void split(__m512 low, __m512 high, __m512i parts[]) {
    for (int i = 0; i < 3; i++) {
        __m512i part = (__m512i)_mm512_cvtne2ps_pbh(high, low);
        parts[i] = part;
        low -= (__m512)_mm512_slli_epi32(_mm512_cvtepu16_epi32(_mm512_castsi512_si256(part)), 16);
        high -= (__m512)_mm512_slli_epi32(_mm512_cvtepu16_epi32(_mm512_extracti64x4_epi64(part, 1)), 16);
    }
}

// 32 numbers of a row, those outside of the mask 0, as parts.
static inline void row(const BF16* p, __mmask32 mask, __m512i parts[]) { parts[0] = _mm512_maskz_loadu_epi16(mask, p); }
static inline void row(const float* p, __mmask32 mask, __m512i parts[]) {
    split(_mm512_maskz_loadu_ps(mask, p), _mm512_maskz_loadu_ps(mask >> 16, p + 16), parts);
}

// Where 32 columns of a row are: those of each mask from a place of their own.
struct Columns {
    int pieces = 0;
    Index starts[PANEL] = {};
    __mmask32 masks[PANEL] = {};

    void add(Index start, Index begin, Index end) {
        starts[pieces] = start, masks[pieces] = first(end) & ~first(begin);
        pieces++;
    }
};

// The same from several places, `most` of them or, if that is 0, as many as there are.
template <int most>
static inline void row(const BF16* p, const Columns& its, __m512i parts[]) {
    __m512i x = _mm512_setzero_si512();
    for (int i = 0; i < (most ? most : its.pieces); i++) x = _mm512_mask_loadu_epi16(x, its.masks[i], p + its.starts[i]);
    parts[0] = x;
}
template <int most>
static inline void row(const float* p, const Columns& its, __m512i parts[]) {
    __m512 low = _mm512_setzero_ps(), high = low;
    for (int i = 0; i < (most ? most : its.pieces); i++) {
        low = _mm512_mask_loadu_ps(low, its.masks[i], p + its.starts[i]);
        high = _mm512_mask_loadu_ps(high, its.masks[i] >> 16, p + its.starts[i] + 16);
    }
    split(low, high, parts);
}

// Two rows of 32 numbers as pairs: those of the first 16 columns, and those of the others.
static inline void interleave(__m512i p, __m512i q, __m512i& low, __m512i& high) {
    const __m512i order = _mm512_set_epi16(47, 15, 46, 14, 45, 13, 44, 12, 43, 11, 42, 10, 41, 9, 40, 8, 39, 7, 38, 6, 37, 5,
                                           36, 4, 35, 3, 34, 2, 33, 1, 32, 0);
    low = _mm512_permutex2var_epi16(p, order, q);
    high = _mm512_permutex2var_epi16(p, _mm512_add_epi16(order, _mm512_set1_epi16(16)), q);
}

// 32 numbers, if some only those of the mask.
struct Two {
    Floats low, high;
};
template <bool some>
static inline Two load_two(const float* p, __mmask32 mask) {
    if (!some) return {load(p), load(p + LANES)};
    return {(Floats)_mm512_maskz_loadu_ps(mask, p), (Floats)_mm512_maskz_loadu_ps(mask >> 16, p + LANES)};
}
template <bool some>
static inline Two load_two(const BF16* p, __mmask32 mask) {
    __m512i x = some ? _mm512_maskz_loadu_epi16(mask, p) : _mm512_loadu_si512(p);
    return {(Floats)_mm512_slli_epi32(_mm512_cvtepu16_epi32(_mm512_castsi512_si256(x)), 16),
            (Floats)_mm512_slli_epi32(_mm512_cvtepu16_epi32(_mm512_extracti64x4_epi64(x, 1)), 16)};
}
template <bool some>
static inline void store_two(float* p, Two x, __mmask32 mask) {
    _mm512_mask_storeu_ps(p, some ? mask : 0xffff, (__m512)x.low);
    _mm512_mask_storeu_ps(p + LANES, some ? mask >> 16 : 0xffff, (__m512)x.high);
}
template <bool some>
static inline void store_two(BF16* p, Two x, __mmask32 mask) {
    _mm512_mask_storeu_epi16(p, some ? mask : ~0u, (__m512i)_mm512_cvtne2ps_pbh((__m512)x.high, (__m512)x.low));
}

// Rows 2j and 2j + 1 of 32 columns, for j from `begin` to `end`, in the two tiles next to each other of a right operand; `read` gives
// the parts of a row. Rows from `depth` on are zeros.
template <class T, class Read>
static inline void lay_pairs(Read read, Index depth, Index begin, Index end, uint16_t* out) {
    for (Index j = begin; j < end; j++) {
        __m512i p[PARTS<T>] = {}, q[PARTS<T>] = {}, low, high;
        if (2 * j < depth) read(2 * j, p);
        if (2 * j + 1 < depth) read(2 * j + 1, q);
        for (int i = 0; i < PARTS<T>; i++) {
            interleave(p[i], q[i], low, high);
            _mm512_store_si512(out + 2 * i * NUMBERS + j * DEPTH, low);
            _mm512_store_si512(out + (2 * i + 1) * NUMBERS + j * DEPTH, high);
        }
    }
}

// A right operand's tile as the left operand's, with the same columns as its rows.
static inline void transpose_tile(uint16_t* tile) {
    __m512i x[TILE];
    for (Index j = 0; j < TILE; j++) x[j] = _mm512_load_si512(tile + j * DEPTH);
    transpose(x);
    for (Index j = 0; j < TILE; j++) _mm512_store_si512(tile + j * DEPTH, x[j]);
}

// One tile of x (across, depth), as the right operand.
template <class T>
static inline void lay_tile_by_row(const T* x, Index stride, Index across, Index depth, uint16_t* out) {
    __m512i tile[PARTS<T>][TILE], parts[PARTS<T>];
    for (Index j = 0; j < TILE; j++) {
        row(x + j * stride, j < across ? first(depth) : 0, parts);
        for (int i = 0; i < PARTS<T>; i++) tile[i][j] = parts[i];
    }
    for (int i = 0; i < PARTS<T>; i++, out += 2 * NUMBERS) {
        transpose(tile[i]);
        for (Index j = 0; j < TILE; j++) _mm512_store_si512(out + j * DEPTH, tile[i][j]);
    }
}

// Where the tile for columns (or rows) from `across` and for step `step` of its panel is, of `steps` a panel.
template <class T>
static inline uint16_t* tile_of(uint16_t* out, Index across, Index step, Index steps) {
    return out + ((across / PANEL * steps + step) * PARTS<T> * 2 + across / TILE % 2) * NUMBERS;
}

// x (depth, across), rows `stride` apart, as the right operand.
template <class T>
static void lay_out_by_depth(const T* x, Index stride, Index across, Index depth, uint16_t* out) {
    const Index steps = steps_of(depth);
    for (Index s = 0; s < steps; s++) {
        for (Index a = 0; a < across; a += PANEL) {
            const T* corner = x + s * DEPTH * stride + a;
            const __mmask32 mask = first(across - a);
            lay_pairs<T>([=](Index j, __m512i* parts) { row(corner + j * stride, mask, parts); }, depth - s * DEPTH, 0, TILE,
                         tile_of<T>(out, a, s, steps));
        }
    }
}

// x (across, depth), at most 32 rows, `stride` apart, as the left operand: row after row, as they are in memory; some steps of a row
// at a time, for who has something else to do meanwhile.
template <class T>
struct LeftRows {
    static constexpr Index AT_ONCE = PARTS<T> == 1 ? 4 : 1;

    const T* x;
    Index stride, across, depth;
    uint16_t* out;
    Index row_of = 0, step = 0;

    Index bits() const { return PANEL * ((steps_of(depth) + AT_ONCE - 1) / AT_ONCE); }
    void lay_out_a_bit() {
        const Index steps = steps_of(depth);
        uint16_t* to = tile_of<T>(out, row_of, step, steps) + row_of % TILE * DEPTH;
        __m512i parts[PARTS<T>];
        for (Index end = least(step + AT_ONCE, steps); step < end; step++) {
            row(x + row_of * stride + step * DEPTH, row_of < across ? first(depth - step * DEPTH) : 0, parts);
            for (int i = 0; i < PARTS<T>; i++, to += 2 * NUMBERS) _mm512_store_si512(to, parts[i]);
        }
        if (step == steps) step = 0, row_of++;
    }
    void lay_out() {
        while (row_of < PANEL) lay_out_a_bit();
    }
};
template <class T>
static inline void lay_out_left(const T* x, Index stride, Index across, Index depth, uint16_t* out) {
    LeftRows<T>{x, stride, across, depth, out}.lay_out();
}

// Some bits of work, as even as can be, in so many calls.
struct Pace {
    Index bits, calls, credit = 0;

    template <class Work>
    void operator()(Work work) {
        for (credit += bits; credit >= calls; credit -= calls) work();
    }
};

// x (across, depth), rows `stride` apart, as the right operand.
template <class T>
static void lay_out_right(const T* x, Index stride, Index across, Index depth, uint16_t* out) {
    const Index steps = steps_of(depth);
    for (Index a = 0; a < up_to(across, PANEL); a += TILE) {
        for (Index s = 0; s < steps; s++) {
            const T* corner = x + a * stride + s * DEPTH;
            lay_tile_by_row(corner, stride, across - a, depth - s * DEPTH, tile_of<T>(out, a, s, steps));
        }
    }
}

// The left operand's 32 rows: where its two tiles are, and how far it is to the next row and to the next step.
struct Left {
    const uint16_t *upper, *lower;
    Index row_bytes, step;

    Left(const uint16_t* panel, int parts) : upper(panel), lower(panel + NUMBERS), row_bytes(64), step(2 * parts * NUMBERS) {}
    Left(const BF16* x, Index stride)
        : upper((const uint16_t*)x), lower((const uint16_t*)(x + TILE * stride)), row_bytes(2 * stride), step(DEPTH) {}
};

// The right operand stays in the nearest cache; or it passes it by, so that the left one stays.
enum Nearest { RIGHT_STAYS, LEFT_STAYS };

// A macro, because an instruction names its register.
#define LOAD_RIGHT(REGISTER, FROM)                                                                                     \
    if constexpr (nearest == LEFT_STAYS) {                                                                             \
        _tile_stream_loadd(REGISTER, FROM, 64);                                                                        \
    } else {                                                                                                           \
        _tile_loadd(REGISTER, FROM, 64);                                                                               \
    }

// Sums 0 and 1 (upper), 2 and 3 (lower) += one part of a step of the left · one of the right, tiles in registers 4 to 7; each is
// loaded, where it is not there yet, just before it is needed.
template <Nearest nearest, bool load_left, bool load_right>
static inline void multiply(const Left& a, Index at, const uint16_t* b) {
    if constexpr (load_right) { LOAD_RIGHT(6, b) }
    if constexpr (load_left) _tile_loadd(4, a.upper + at, a.row_bytes);
    _tile_dpbf16ps(0, 4, 6);
    if constexpr (load_left) _tile_loadd(5, a.lower + at, a.row_bytes);
    _tile_dpbf16ps(2, 5, 6);
    if constexpr (load_right) { LOAD_RIGHT(7, b + NUMBERS) }
    _tile_dpbf16ps(1, 4, 7);
    _tile_dpbf16ps(3, 5, 7);
}

// Products of parts that make one of numbers.
template <int parts>
constexpr Index PRODUCTS = parts * (parts + 1) / 2;

// The 32×32 sums in registers 0 to 3 += one step of the left · one of the right. After each product of parts goes on what else there
// is to do: tiles are multiplied beside it, as long as it is little at a time.
template <int parts, Nearest nearest, class Meanwhile>
static inline void add_step(const Left& a, Index at, const uint16_t* b, Meanwhile meanwhile) {
    constexpr Index PART = 2 * NUMBERS;
    if constexpr (parts == 1) {
        multiply<nearest, true, true>(a, at, b);
    } else {
        multiply<RIGHT_STAYS, true, true>(a, at, b);
        meanwhile();
        multiply<RIGHT_STAYS, false, true>(a, at, b + 2 * PART);
        meanwhile();
        multiply<RIGHT_STAYS, false, true>(a, at, b + PART);
        meanwhile();
        multiply<RIGHT_STAYS, true, false>(a, at + PART, b);
        meanwhile();
        multiply<RIGHT_STAYS, false, true>(a, at, b);
        meanwhile();
        multiply<RIGHT_STAYS, true, false>(a, at + 2 * PART, b);
    }
    meanwhile();
}

// The same where there are fewer rows (tall: 1 for 16) or columns (wide).
template <int parts, Nearest nearest, int tall, int wide, class Meanwhile>
static inline void add_some_step(const Left& a, Index at, const uint16_t* b, Meanwhile meanwhile) {
    for (int left = 0; left < parts; left++) {
        _tile_loadd(4, a.upper + at + 2 * left * NUMBERS, a.row_bytes);
        if (tall == 2) _tile_loadd(5, a.lower + at + 2 * left * NUMBERS, a.row_bytes);
        for (int i = 0; i < parts - left; i++) {
            const int right = left == 0 ? (parts - i) % parts : parts - left - 1 - i;  // the order of whole steps
            LOAD_RIGHT(6, b + 2 * right * NUMBERS)
            if (wide == 2) { LOAD_RIGHT(7, b + (2 * right + 1) * NUMBERS) }
            _tile_dpbf16ps(0, 4, 6);
            if (wide == 2) _tile_dpbf16ps(1, 4, 7);
            if (tall == 2) _tile_dpbf16ps(2, 5, 6);
            if (tall == 2 && wide == 2) _tile_dpbf16ps(3, 5, 7);
            meanwhile();
        }
    }
}

// All steps; meanwhile(i) counts products of parts.
template <int parts, Nearest nearest, int tall, int wide, class Meanwhile>
static inline void add_steps(const Left& a, const uint16_t* b, Index steps, bool backwards, Meanwhile meanwhile) {
    Index products = 0;
    const auto work = [&] { meanwhile(products++); };
    for (Index i = 0; i < steps; i++) {
        const Index s = backwards ? steps - 1 - i : i;
        if constexpr (tall == 2 && wide == 2)
            add_step<parts, nearest>(a, s * a.step, b + s * 2 * parts * NUMBERS, work);
        else
            add_some_step<parts, nearest, tall, wide>(a, s * a.step, b + s * 2 * parts * NUMBERS, work);
    }
}
template <int parts, Nearest nearest, class Meanwhile>
static inline void add_steps(bool tall, bool wide, const Left& a, const uint16_t* b, Index steps, bool backwards, Meanwhile meanwhile) {
    if (tall && wide)
        add_steps<parts, nearest, 2, 2>(a, b, steps, backwards, meanwhile);
    else if (tall)
        add_steps<parts, nearest, 2, 1>(a, b, steps, backwards, meanwhile);
    else if (wide)
        add_steps<parts, nearest, 1, 2>(a, b, steps, backwards, meanwhile);
    else
        add_steps<parts, nearest, 1, 1>(a, b, steps, backwards, meanwhile);
}

// The 32×32 sums in memory, row by row.
static inline void load_sums(const float* c) {
    _tile_loadd(0, c, 4 * PANEL);
    _tile_loadd(1, c + TILE, 4 * PANEL);
    _tile_loadd(2, c + TILE * PANEL, 4 * PANEL);
    _tile_loadd(3, c + TILE * PANEL + TILE, 4 * PANEL);
}
static inline void store_sums(float* c) {
    _tile_stored(0, c, 4 * PANEL);
    _tile_stored(1, c + TILE, 4 * PANEL);
    _tile_stored(2, c + TILE * PANEL, 4 * PANEL);
    _tile_stored(3, c + TILE * PANEL + TILE, 4 * PANEL);
}
static inline void zero_sums() {
    _tile_zero(0);
    _tile_zero(1);
    _tile_zero(2);
    _tile_zero(3);
}

// Memory of a thread, kept.
struct Scratch {
    char* p = nullptr;
    size_t size = 0;
    void* get(size_t bytes) {
        if (bytes > size) {
            std::free(p);
            p = (char*)std::aligned_alloc(4096, size = up_to(bytes + bytes / 4, 4096));
        }
        return p;
    }
    ~Scratch() { std::free(p); }
};

#endif
