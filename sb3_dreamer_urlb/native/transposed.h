// leftᵀ · right on tiles, where both have many rows: the gradient of weights.
#pragma once

#include "tiles.h"

#ifdef HAS_TILES

constexpr Index ROWS = 320, COLUMNS = 512;  // laid out at a time, at most
constexpr Index CACHE = 3 << 19;              // bytes: most of a core's

// Rows of a matrix (rows, n), `stride` apart, as the right operand.
template <class T>
struct PlainRows {
    const T* x;
    Index stride;

    void find(Index r, Index count, const T** rows) const {
        for (Index i = 0; i < count; i++) rows[i] = x + (r + i) * stride;
    }
    // Up to 32 columns from c on.
    Columns columns(Index c, Index count) const {
        Columns its;
        its.add(c, 0, count);
        return its;
    }
};

// Some rows and columns of both operands, laid out bit by bit, so that each bit finds its place beside tiles that are multiplied.
// A piece is 32 rows × 32 columns; the left one's come first.
template <class T, class Right>
struct Pieces {
    static constexpr Index PAIRS = PARTS<T> == 1 ? 4 : 1;   // of rows, a bit
    static constexpr Index RIGHT_BITS = TILE / PAIRS, LEFT_BITS = RIGHT_BITS + 2 * PARTS<T>;  // of a piece; the left one's tiles are transposed

    const T* left;
    Index left_stride, m;
    const Right* right;
    Index begin, count, columns;
    const T* rows[ROWS];
    Columns places[COLUMNS / PANEL];
    uint16_t *laid_left, *laid_right;
    Index step = 0, across = 0, bit = 0;
    bool at_right = false;

    void start(Index its_begin, Index its_count, Index c, Index its_columns) {
        begin = its_begin, count = its_count, columns = its_columns;
        step = across = bit = 0, at_right = false;
        right->find(begin, count, rows);
        for (Index a = 0; a < columns; a += PANEL) places[a / PANEL] = right->columns(c + a, least(columns - a, PANEL));
    }
    Index bits() const {
        return steps_of(count) * (panels_of(m) * LEFT_BITS + panels_of(columns) * RIGHT_BITS);
    }
    void lay_out_a_bit() {
        const Index steps = steps_of(count), r = step * DEPTH;
        uint16_t* const out = tile_of<T>(at_right ? laid_right : laid_left, across, step, steps);
        if (at_right)
            lay_right(rows + r, places[across / PANEL], count - r, out);
        else if (bit < RIGHT_BITS)
            lay_left(left + (begin + r) * left_stride + across, first(m - across), count - r, out);
        else
            transpose_tile(out + (bit - RIGHT_BITS) * NUMBERS);
        if (++bit < (at_right ? RIGHT_BITS : LEFT_BITS)) return;
        bit = 0, across += PANEL;
        if (across < (at_right ? columns : m)) return;
        across = 0;
        if (++step == steps) step = 0, at_right = true;
    }

  private:
    void lay_left(const T* x, __mmask32 mask, Index depth, uint16_t* out) const {
        lay([=](Index j, __m512i* parts) { row(x + j * left_stride, mask, parts); }, depth, out);
    }
    void lay_right(const T* const* x, const Columns& its, Index depth, uint16_t* out) const {
        if (its.pieces == 1)
            lay([=, start = its.starts[0], mask = its.masks[0]](Index j, __m512i* parts) { row(x[j] + start, mask, parts); }, depth, out);
        else if (its.pieces <= 4)
            lay([=, &its](Index j, __m512i* parts) { row<4>(x[j], its, parts); }, depth, out);
        else
            lay([=, &its](Index j, __m512i* parts) { row<0>(x[j], its, parts); }, depth, out);
    }
    template <class Read>
    void lay(Read read, Index depth, uint16_t* out) const {
        lay_pairs<T>(read, depth, bit * PAIRS, (bit + 1) * PAIRS, out);
    }
};

// While some rows are multiplied, the next ones are laid out.
template <class T, class Right>
static void add_transposed_product(const T* left, Index left_stride, const Right& right, float* sums, Index begin, Index rows, Index m,
                                   Index n) {
    static thread_local Scratch scratch;
    const Index wide = least(n, COLUMNS), across = up_to(m, PANEL) + up_to(wide, PANEL);
    // Both pieces and the sums stay in a core's cache.
    const Index room = CACHE - up_to(m, PANEL) * wide * sizeof(float), fit = room / (2 * across * PARTS<T> * (Index)sizeof(uint16_t));
    const Index size = least(least(up_to(rows, DEPTH), ROWS), fit < 4 * DEPTH ? 4 * DEPTH : fit / DEPTH * DEPTH);
    const Index laid_left = laid_size<T>(m, size), laid = laid_left + laid_size<T>(wide, size);
    uint16_t* memory = (uint16_t*)scratch.get(2 * laid * sizeof(uint16_t));
    Pieces<T, Right> pieces[2];
    for (int i = 0; i < 2; i++, memory += laid) {
        pieces[i].left = left, pieces[i].left_stride = left_stride, pieces[i].m = m, pieces[i].right = &right;
        pieces[i].laid_left = memory, pieces[i].laid_right = memory + laid_left;
    }
    Tiles tiles;
    pieces[0].start(begin, least(rows, size), 0, wide);
    for (Index k = pieces[0].bits(); k > 0; k--) pieces[0].lay_out_a_bit();
    int turn = 0;
    for (Index c = 0; c < n; c += COLUMNS) {
        for (Index r = 0; r < rows; r += size, turn = 1 - turn) {
            Pieces<T, Right>&now = pieces[turn], &next = pieces[1 - turn];
            const Index steps = steps_of(now.count), panel = steps * 2 * PARTS<T> * NUMBERS;
            const Index panels = panels_of(m) * panels_of(now.columns);
            Pace pace = {0, panels * steps * PRODUCTS<PARTS<T>>};
            if (r + size < rows)
                next.start(begin + r + size, least(rows - r - size, size), c, now.columns), pace.bits = next.bits();
            else if (c + COLUMNS < n)
                next.start(begin, least(rows, size), c + COLUMNS, least(n - c - COLUMNS, COLUMNS)), pace.bits = next.bits();
            const auto meanwhile = [&](Index) { pace([&] { next.lay_out_a_bit(); }); };
            float* sum = sums + up_to(m, PANEL) * c;
            for (Index i = 0; i < m; i += PANEL) {
                for (Index j = 0; j < now.columns; j += PANEL, sum += PANEL * PANEL) {
                    for (Index k = 0; k < PANEL * PANEL; k += TILE) __builtin_prefetch(sum + PANEL * PANEL + k, 1);
                    if (r > 0)
                        load_sums(sum);
                    else
                        zero_sums();
                    add_steps<PARTS<T>, LEFT_STAYS>(m - i > TILE, now.columns - j > TILE, Left(now.laid_left + i / PANEL * panel, PARTS<T>),
                                        now.laid_right + j / PANEL * panel, steps, j / PANEL % 2, meanwhile);
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
        const Index c = j / COLUMNS * COLUMNS, across = panels_of(least(n - c, COLUMNS));
        const Index block = up_to(m, PANEL) * c + (i / PANEL * across + (j - c) / PANEL) * PANEL * PANEL;
        const float* at = sums + block + i % PANEL * PANEL + j % PANEL;
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
