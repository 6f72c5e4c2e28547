// What follows a product on tiles before its sums leave the processor.
#pragma once

#include "activation.h"
#include "tiles.h"

#ifdef HAS_TILES

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

// What becomes of a product: + bias (outputs,) + plus (rows, outputs), then ELU. Null: not.
template <class Out, class Plus = Out>
struct Behind {
    const float* bias;
    const Plus* plus;
    Index plus_stride;
    bool elu;
    Out* out;
    Index out_stride;

    // sums: 32 rows and 32 columns of the result; the rows from begin to end and the first columns.
    void operator()(const float* sums, Index r, Index c, Index begin, Index end, Index columns) const {
        if (columns < PANEL)
            write<true>(sums, r, c, begin, end, columns);
        else
            write<false>(sums, r, c, begin, end, columns);
    }

    template <bool some>
    void write(const float* sums, Index r, Index c, Index begin, Index end, Index columns) const {
        const Plus* its_plus = plus ? plus + r * plus_stride + c : nullptr;
        Out* its_out = out + (r + begin) * out_stride + c;
        const bool its_elu = elu;
        const __mmask32 mask = first(columns);
        const Two b = !bias ? Two{} : load_two<some>(bias + c, mask);
        for (Index i = begin; i < end; i++, its_out += out_stride) {
            Two y = {load(sums + i * PANEL) + b.low, load(sums + i * PANEL + TILE) + b.high};
            if (its_plus) {
                Two p = load_two<some>(its_plus + i * plus_stride, mask);
                y = {y.low + p.low, y.high + p.high};
            }
            if (its_elu) y = {elu_in<Out>(y.low), elu_in<Out>(y.high)};
            store_two<some>(its_out, y, mask);
        }
    }
};

// How often the multiplication of so many rows with weights says `meanwhile`.
template <class T>
static inline Index calls_of(Index rows, Index steps, Index outputs) {
    return panels_of(rows) * panels_of(outputs) * steps * PRODUCTS<PARTS<T>>;
}

// Rows of the left operand · weights laid out: each panel of weights meets all the rows, 32 at a time, `left(i)` says where the i-th
// ones are. What follows one product is done while the next is multiplied, and so is what else there is to do. r: where these
// rows are in the result.
template <class T, Nearest nearest, class Lefts, class Following, class Meanwhile>
static inline void blocks_by_weights(Lefts left, Index rows, const uint16_t* weights, Index steps, Index outputs, Index r,
                                     const Following& behind, Meanwhile meanwhile) {
    alignas(64) float sums[PANEL * PANEL];
    const Index products = steps * PRODUCTS<PARTS<T>>, least_share = (PANEL + products - 1) / products;
    const Index share = PARTS<T> == 1 && least_share < 3 ? 3 : least_share;
    Index row = 0, column = 0, height = 0, width = 0;  // of the product before
    bool backwards = false;
    for (Index c = 0; c < outputs; c += PANEL, weights += steps * 2 * PARTS<T> * NUMBERS) {
        for (Index i = 0; i < rows; i += PANEL) {
            zero_sums();
            // Who goes backwards every other time finds in the nearest cache what was read last.
            add_steps<PARTS<T>, nearest>(rows - i > TILE, outputs - c > TILE, left(i / PANEL), weights, steps, backwards,
                                         [=, &behind, &sums, &meanwhile](Index done) {
                if (done * share < height) behind(sums, r + row, column, done * share, least((done + 1) * share, height), width);
                meanwhile();
            });
            store_sums(sums);
            row = i, column = c, height = least(rows - i, PANEL), width = least(outputs - c, PANEL);
            if (nearest == RIGHT_STAYS) backwards = !backwards;
        }
    }
    behind(sums, r + row, column, 0, height, width);
}

// The same of 32 rows at most.
template <class T, class Following>
static inline void block_by_weights(const Left& left, const uint16_t* weights, Index steps, Index outputs, Index r, Index height,
                                    const Following& behind) {
    blocks_by_weights<T, LEFT_STAYS>([&](Index) { return left; }, height, weights, steps, outputs, r, behind, [] {});
}

// The rows of one of several threads, inside a parallel region: as even as tiles allow.
struct Share {
    Index begin, end;

    explicit Share(Index rows) {
        const Index tiles = (rows + TILE - 1) / TILE, me = omp_get_thread_num(), all_of_us = omp_get_num_threads();
        begin = tiles * me / all_of_us * TILE, end = least(tiles * (me + 1) / all_of_us * TILE, rows);
    }
};
static inline Index useful_threads(Index rows, Index threads) { return least(threads, panels_of(rows)); }

#endif
