// A layer whose input is mostly ones at known places: rows of its weights are added up, and a few columns times numbers.
//
// Weights lie in rows of whole cache lines (`stride` numbers apart). The sums of a state stay in registers, in float32.
#pragma once

#include "lanes.h"

// float16: more digits than bfloat16, less range.
struct Half {
    uint16_t bits;
};

// A cache line of numbers in float32.
template <class T>
struct Line;

template <>
struct Line<float> {
    static constexpr Index SIZE = LANES;
    Floats x;
    static Line from(const float* p) { return {load(p)}; }
    static Line from(const float* p, Index count) { return {load_up_to(p, count)}; }
    void add(const Line& other) { x += other.x; }
    void add(float factor, const Line& other) { x += factor * other.x; }
    void apply_elu() { x = elu(x); }
    void put(float* p, Index count) const { store_up_to(p, x, count); }
};

// Of two bytes each.
template <>
struct Line<BF16> {
    static constexpr Index SIZE = 2 * LANES;
    Floats low, high;
    static Line from(const BF16* p) { return {load(p), load(p + LANES)}; }
    static Line from(const BF16* p, Index count) {
        return {load_up_to(p, count), count > LANES ? load_up_to(p + LANES, count - LANES) : all(0)};
    }
    void add(const Line& other) { low += other.low, high += other.high; }
    void add(float factor, const Line& other) { low += factor * other.low, high += factor * other.high; }
    void apply_elu() { low = elu_in<BF16>(low), high = elu_in<BF16>(high); }
    void put(BF16* p, Index count) const {
        store_up_to(p, low, count);
        if (count > LANES) store_up_to(p + LANES, high, count - LANES);
    }
};

// The sum of a line in each of four rows; `i`: where in the row.
template <class T, class L>
static inline void add_four(L& sums, const T* const rows[4], Index i) {
    for (int r = 0; r < 4; r++) sums.add(L::from(rows[r] + i));
}

#ifdef __AVX512FP16__
static inline Line<BF16> widened(__m512h x) {
    const __m512i bits = (__m512i)x;
    return {(Floats)_mm512_cvtph_ps(_mm512_castsi512_si256(bits)), (Floats)_mm512_cvtph_ps(_mm512_extracti64x4_epi64(bits, 1))};
}
static inline Line<BF16> line_from(const Half* p) { return widened(read<__m512h>(p)); }

// A half of the instructions that lines of bfloat16 take.
static inline void add_four(Line<BF16>& sums, const Half* const rows[4], Index i) {
    __m512h four[4];
    for (int r = 0; r < 4; r++) four[r] = read<__m512h>(rows[r] + i);
    sums.add(widened((four[0] + four[1]) + (four[2] + four[3])));
}
#endif
template <class T>
static inline Line<T> line_from(const T* p) {
    return Line<T>::from(p);
}

// `T`: the weights' format. Below, `U`: that of what comes out.
template <class T>
struct SparseLayer {
    const T *rows, *others, *bias;  // of the ones, of the other numbers, null for none
    Index variables, count, stride, width;
    bool with_elu;
};

// Some lines of one state.
template <class T, class U, int LINES>
static void lines(const SparseLayer<T>& layer, const Index* classes, const float* x, const U* addend, U* out, Index first) {
    using L = Line<U>;
    L sums[LINES];
#pragma GCC unroll 16
    for (int i = 0; i < LINES; i++) sums[i] = layer.bias ? line_from(layer.bias + first + i * L::SIZE) : L{};
    auto row = [&](Index s) { return layer.rows + classes[s] * layer.stride + first; };
    Index s = 0;
    for (; s + 4 <= layer.variables; s += 4) {
        const T* const rows[4] = {row(s), row(s + 1), row(s + 2), row(s + 3)};
#pragma GCC unroll 16
        for (int i = 0; i < LINES; i++) add_four(sums[i], rows, i * L::SIZE);
    }
    for (; s < layer.variables; s++) {
#pragma GCC unroll 16
        for (int i = 0; i < LINES; i++) sums[i].add(line_from(row(s) + i * L::SIZE));
    }
    for (Index a = 0; a < layer.count; a++) {
        const T* other = layer.others + a * layer.stride + first;
#pragma GCC unroll 16
        for (int i = 0; i < LINES; i++) sums[i].add(x[a], line_from(other + i * L::SIZE));
    }
#pragma GCC unroll 16
    for (int i = 0; i < LINES; i++) {
        const Index begin = first + i * L::SIZE, left = layer.width - begin;
        if (addend) sums[i].add(L::from(addend + begin, left));
        if (layer.with_elu) sums[i].apply_elu();
        sums[i].put(out + begin, left);
    }
}

// One state: classes (variables), x (count), addend (width) or null → out (width).
template <class T, class U>
static inline void sum_row(const SparseLayer<T>& layer, const Index* classes, const float* x, const U* addend, U* out) {
    const Index size = Line<U>::SIZE;
    // Thirteen lines at once are what registers hold.
    for (Index i = 0, left = (layer.width + size - 1) / size, some; left > 0; i += some, left -= some) {
        some = left >= 13 ? 13 : left >= 7 ? 7 : left >= 4 ? 4 : left >= 2 ? 2 : 1;
        auto its = some == 13 ? lines<T, U, 13> : some == 7 ? lines<T, U, 7> : some == 4 ? lines<T, U, 4>
                   : some == 2 ? lines<T, U, 2> : lines<T, U, 1>;
        its(layer, classes, x, addend, out, i * size);
    }
}
