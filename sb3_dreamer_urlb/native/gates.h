// What the GRU does behind its product, for one row: a layer norm over all three parts, two gates, a candidate, the new state.
#pragma once

#include "lanes.h"

// The sum of some function of numbers; four sums at a time, because each addition waits for the one before.
template <class T, class F>
static inline float sum_of(const T* x, Index size, F of) {
    Floats sums[4] = {};
    Index i = 0;
    for (; i + 4 * LANES <= size; i += 4 * LANES) {
        for (Index j = 0; j < 4; j++) sums[j] += of(load(x + i + j * LANES));
    }
    for (; i < size; i += LANES) sums[0] += first_lanes(of(load_up_to(x + i, size - i)), size - i);
    return total((sums[0] + sums[1]) + (sums[2] + sums[3]));
}

// Mean and 1 / standard deviation of a row.
struct Norm {
    float mean, scale;
};
template <class T>
static inline Norm norm_of(const T* row, Index size, float epsilon) {
    const float mean = sum_of(row, size, [](Floats x) { return x; }) / size;
    const float variance = sum_of(row, size, [mean](Floats x) { return (x - mean) * (x - mean); }) / size;
    return {mean, 1.0f / __builtin_sqrtf(variance + epsilon)};
}

// What sixteen numbers of the three parts give.
struct Gates {
    Floats reset, input, candidate, update;

    template <class T>
    static Gates of(const T* row, const float* weight, const float* bias, Norm norm, Index i, Index size) {
        auto normed = [&](Index at) {
            return (load_up_to(row + at, size - i) - norm.mean) * norm.scale * load_up_to(weight + at, size - i) +
                   load_up_to(bias + at, size - i);
        };
        const Floats reset = sigmoid(normed(i)), input = normed(size + i);
        return {reset, input, tanh(reset * input), sigmoid(normed(2 * size + i) - 1.0f)};
    }
};

// parts (3 · size): reset, candidate, update, before their norm with weight and bias (3 · size); old (size) → deter (size), which may
// be old, and the same in T, null for none. A bias of -1 makes a fresh GRU forget slowly.
template <class T>
static inline void gates_of_row(const T* parts, const float* weight, const float* bias, float epsilon, const float* old, float* deter,
                                T* shorter, Index size) {
    const Norm norm = norm_of(parts, 3 * size, epsilon);
    for (Index i = 0; i < size; i += LANES) {
        const Gates its = Gates::of(parts, weight, bias, norm, i, size);
        const Floats before = load_up_to(old + i, size - i), now = before + its.update * (its.candidate - before);
        store_up_to(deter + i, now, size - i);
        if (shorter) store_up_to(shorter + i, now, size - i);
    }
}
