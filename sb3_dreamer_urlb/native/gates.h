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

// Mean and 1 / standard deviation of a row. Here and below, `As`: as exactly as numbers of this format need it.
struct Norm {
    float mean, scale;
};
template <class As, class T>
static inline Norm norm_of(const T* row, Index size, float epsilon) {
#ifdef __AVX512DQ__
    if constexpr (std::is_same_v<As, BF16> && std::is_same_v<T, BF16>) {
        // In one pass: what that may cost is less than what rounding the numbers to bfloat16 has cost.
        Floats sums[2] = {}, squares[2] = {};
        for (Index i = 0; i < size; i += 2 * LANES) {
            const Index left = size - i;
            const auto [even, odd] = Pairs::from(_mm512_maskz_loadu_epi16(left < 32 ? (1u << left) - 1 : ~0u, row + i));
            sums[0] += even, sums[1] += odd;
            squares[0] += even * even, squares[1] += odd * odd;
        }
        const float mean = total(sums[0] + sums[1]) / size, variance = total(squares[0] + squares[1]) / size - mean * mean;
        return {mean, 1.0f / __builtin_sqrtf((variance < 0 ? 0 : variance) + epsilon)};
    }
#endif
    const float mean = sum_of(row, size, [](Floats x) { return x; }) / size;
    const float variance = sum_of(row, size, [mean](Floats x) { return (x - mean) * (x - mean); }) / size;
    return {mean, 1.0f / __builtin_sqrtf(variance + epsilon)};
}

// What sixteen numbers of the three parts give.
struct Gates {
    Floats reset, input, candidate, update;

    template <class As, class T>
    static Gates of(const T* row, const float* weight, const float* bias, Norm norm, Index i, Index size) {
        auto normed = [&](Index at) {
            return (load_up_to(row + at, size - i) - norm.mean) * norm.scale * load_up_to(weight + at, size - i) +
                   load_up_to(bias + at, size - i);
        };
        const Floats reset = sigmoid<As>(normed(i)), input = normed(size + i);
        return {reset, input, tanh<As>(reset * input), sigmoid<As>(normed(2 * size + i) - 1.0f)};
    }
};

// parts (3 · size): reset, candidate, update, before their norm with weight and bias (3 · size); old (size) → deter (size), which may
// be old, and the same in As, null for none. A bias of -1 makes a fresh GRU forget slowly.
template <class As, class T>
static inline void gates_of_row(const T* parts, const float* weight, const float* bias, float epsilon, const float* old, float* deter,
                                As* shorter, Index size) {
    const Norm norm = norm_of<As>(parts, 3 * size, epsilon);
    for (Index i = 0; i < size; i += LANES) {
        const Gates its = Gates::of<As>(parts, weight, bias, norm, i, size);
        const Floats before = load_up_to(old + i, size - i), now = before + its.update * (its.candidate - before);
        store_up_to(deter + i, now, size - i);
        if (shorter) store_up_to(shorter + i, now, size - i);
    }
}
