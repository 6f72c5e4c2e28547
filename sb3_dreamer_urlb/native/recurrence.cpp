// What the GRU does behind its product: a layer norm over all three parts, two gates, a candidate, the new state; and its gradient.

#include "lanes.h"

#include <vector>

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

// parts (rows, 3 · size): reset, candidate, update, before their norm with weight and bias (3 · size); old (rows, size) → deter (rows,
// size), and the same in T, its rows short_stride apart; null for none. A bias of -1 makes a fresh GRU forget slowly.
template <class T>
static void gates(const T* parts, const float* weight, const float* bias, float epsilon, const float* old, float* deter, T* shorter,
                  Index short_stride, Index rows, Index size, int threads) {
#pragma omp parallel for num_threads(threads) schedule(static) if (rows * size > WORTH_A_THREAD / 4)
    for (Index r = 0; r < rows; r++) {
        const T* row = parts + r * 3 * size;
        const Norm norm = norm_of(row, 3 * size, epsilon);
        for (Index i = 0; i < size; i += LANES) {
            const Gates its = Gates::of(row, weight, bias, norm, i, size);
            const Floats before = load_up_to(old + r * size + i, size - i), now = before + its.update * (its.candidate - before);
            store_up_to(deter + r * size + i, now, size - i);
            if (shorter) store_up_to(shorter + r * short_stride + i, now, size - i);
        }
    }
}

// grad (rows, size) of the new state → those of parts and of the old state.
template <class T>
static void gates_backward(const float* grad, const T* parts, const float* weight, const float* bias, float epsilon, const float* old,
                           T* parts_grad, float* old_grad, Index rows, Index size, int threads) {
#pragma omp parallel num_threads(threads) if (rows * size > WORTH_A_THREAD / 4)
    {
        std::vector<float> of_normed(3 * size + LANES);
#pragma omp for schedule(static)
        for (Index r = 0; r < rows; r++) {
            const T* row = parts + r * 3 * size;
            const Norm norm = norm_of(row, 3 * size, epsilon);
            Floats sums = all(0), products = all(0);
            // Of the normed number · its weight; and what the norm's gradient needs to know of all of them.
            auto put = [&](Index i, Index at, Floats g) {
                g = first_lanes(g * load_up_to(weight + at, size - i), size - i);
                store_up_to(of_normed.data() + at, g, size - i);
                sums += g;
                products += g * (load_up_to(row + at, size - i) - norm.mean) * norm.scale;
            };
            for (Index i = 0; i < size; i += LANES) {
                const Gates its = Gates::of(row, weight, bias, norm, i, size);
                const Floats g = load_up_to(grad + r * size + i, size - i), before = load_up_to(old + r * size + i, size - i);
                store_up_to(old_grad + r * size + i, g * (1.0f - its.update), size - i);
                const Floats product = g * its.update * (1.0f - its.candidate * its.candidate);  // of reset · input
                put(i, i, product * its.input * its.reset * (1.0f - its.reset));
                put(i, size + i, product * its.reset);
                put(i, 2 * size + i, g * (its.candidate - before) * its.update * (1.0f - its.update));
            }
            const float mean = total(sums) / (3 * size), slope = total(products) / (3 * size);
            for (Index i = 0; i < 3 * size; i += LANES) {
                const Floats normed = (load_up_to(row + i, 3 * size - i) - norm.mean) * norm.scale;
                const Floats g = (load_up_to(of_normed.data() + i, 3 * size - i) - mean - normed * slope) * norm.scale;
                store_up_to(parts_grad + r * 3 * size + i, g, 3 * size - i);
            }
        }
    }
}

#define FOR(T, NAME)                                                                                                       \
    EXPORT void gates_##NAME(const T* parts, const float* weight, const float* bias, float epsilon, const float* old,      \
                             float* deter, T* shorter, Index short_stride, Index rows, Index size, int threads) {          \
        gates(parts, weight, bias, epsilon, old, deter, shorter, short_stride, rows, size, threads);                       \
    }                                                                                                                      \
    EXPORT void gates_backward_##NAME(const float* grad, const T* parts, const float* weight, const float* bias, float epsilon, \
                                      const float* old, T* parts_grad, float* old_grad, Index rows, Index size, int threads) { \
        gates_backward(grad, parts, weight, bias, epsilon, old, parts_grad, old_grad, rows, size, threads);                \
    }
FOR(float, float)
FOR(BF16, bfloat16)
