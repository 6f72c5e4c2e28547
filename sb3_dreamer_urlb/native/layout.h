// Operands of products on tiles, as they are laid out: in panels of 32 rows (left) or columns (right), two tiles for each 32 numbers
// of depth, one step. A right operand's numbers lie in pairs: row j of a tile holds those of depth 2j and 2j + 1, by turns.
//
// A float32 number is the sum of three bfloat16 numbers; laid out as three parts, six products of parts give the product of the
// numbers as exactly as float32 does (the three left out are below its rounding).
#pragma once

#if defined(__AMX_TILE__) && defined(__AMX_BF16__) && defined(__AVX512BF16__) && defined(__AVX512BW__)
#define HAS_TILES 1

#include "vectors.h"

constexpr Index TILE = 16, PANEL = 2 * TILE, DEPTH = 32, NUMBERS = TILE * DEPTH;

static inline Index up_to(Index x, Index multiple) { return (x + multiple - 1) / multiple * multiple; }
static inline Index steps_of(Index depth) { return (depth + DEPTH - 1) / DEPTH; }
static inline Index panels_of(Index across) { return (across + PANEL - 1) / PANEL; }
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

#endif
