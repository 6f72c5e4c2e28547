// leftᵀ · right on tiles, where both have many rows: the gradient of weights.
#pragma once

#include "tiles.h"

#ifdef HAS_TILES

constexpr Index ROWS = 320, COLUMNS = 512;  // laid out at a time: together with their sums, what a core's cache holds

// Rows of a matrix (rows, n), `stride` apart, as the right operand.
template <class T>
struct PlainRows {
    const T* x;
    Index stride;

    static Index scratch(Index) { return 0; }
    void lay_out(Index r, Index count, Index c, Index columns, T*, uint16_t* out) const {
        lay_out_by_depth<RIGHT>(x + r * stride + c, stride, columns, count, out);
    }
};

template <class T, class Right>
static void add_transposed_product(const T* left, Index left_stride, const Right& right, float* sums, Index begin, Index rows, Index m,
                                   Index n) {
    static thread_local Scratch scratch;
    const Index size = least(up_to(rows, DEPTH), ROWS), wide = least(n, COLUMNS);
    const Index laid = laid_size<T>(m, size) + laid_size<T>(wide, size);
    uint16_t* laid_left = (uint16_t*)scratch.get(laid * sizeof(uint16_t) + right.scratch(wide) * sizeof(T));
    uint16_t* laid_right = laid_left + laid_size<T>(m, size);
    T* its = (T*)(laid_left + laid);
    Tiles tiles;
    for (Index c = 0; c < n; c += COLUMNS) {
        const Index columns = least(n - c, COLUMNS);
        for (Index r = 0; r < rows; r += size) {
            const Index count = least(rows - r, size), panel = steps_of(count) * 2 * PARTS<T> * NUMBERS;
            lay_out_by_depth<LEFT>(left + (begin + r) * left_stride, left_stride, m, count, laid_left);
            right.lay_out(begin + r, count, c, columns, its, laid_right);
            float* sum = sums + up_to(m, PANEL) * c;
            for (Index i = 0; i < m; i += PANEL) {
                for (Index j = 0; j < columns; j += PANEL, sum += PANEL * PANEL) {
                    for (Index k = 0; k < PANEL * PANEL; k += TILE) __builtin_prefetch(sum + PANEL * PANEL + k, 1);
                    if (r > 0)
                        load_sums(sum);
                    else
                        zero_sums();
                    add_steps<PARTS<T>>(Left(laid_left + i / PANEL * panel, PARTS<T>), laid_right + j / PANEL * panel, steps_of(count),
                                        j / PANEL % 2, [](Index) {});
                    store_sums(sum);
                }
            }
        }
    }
}

// Row i of the product of all threads, n numbers.
static inline void gather_row(const float* sums, Index i, Index m, Index n, Index threads, float* row) {
    const Index size = up_to(m, PANEL) * up_to(n, PANEL);
    for (Index j = 0; j < n; j += TILE) {
        const Index c = j / COLUMNS * COLUMNS, across = up_to(least(n - c, COLUMNS), PANEL) / PANEL;
        const Index block = up_to(m, PANEL) * c + (i / PANEL * across + (j - c) / PANEL) * PANEL * PANEL;
        const float* at = sums + block + ((i / TILE % 2 * 2 + j / TILE % 2) * TILE + i % TILE) * TILE;
        Floats total = load(at);
        for (Index t = 1; t < threads; t++) total += load(at + t * size);
        _mm512_mask_storeu_ps(row + j, first(least(n - j, TILE)), (__m512)total);
    }
}

// sums: room for threads · up_to(m, 32) · up_to(n, 32). A row of the product, (places, n / places), becomes (n / places, places).
template <class T, class Right>
static void transposed_product(const T* left, Index left_stride, const Right& right, float* sums, float* out, Index rows, Index m,
                               Index n, Index places, int threads) {
    const Index size = up_to(m, PANEL) * up_to(n, PANEL), few = n / places;
#pragma omp parallel num_threads(threads)
    {
        const Index share = up_to((rows + omp_get_num_threads() - 1) / omp_get_num_threads(), DEPTH);
        const Index me = omp_get_thread_num(), us = (rows + share - 1) / share, begin = share * me, count = least(rows - begin, share);
        if (count > 0) add_transposed_product(left, left_stride, right, sums + me * size, begin, count, m, n);
#pragma omp barrier
        static thread_local Scratch scratch;
        float* row = (float*)scratch.get(n * sizeof(float));
#pragma omp for schedule(static)
        for (Index i = 0; i < m; i++) {
            float* to = out + i * n;
            gather_row(sums, i, m, n, us, places > 1 ? row : to);
            if (places > 1)
                for (Index f = 0; f < few; f++)
                    for (Index p = 0; p < places; p++) *to++ = row[p * few + f];
        }
    }
}

#endif
