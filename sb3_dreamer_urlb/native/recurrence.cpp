// What the GRU does behind its product (gates.h), for all rows; and its gradient.

#include "gates.h"

#include <vector>

// parts (rows, 3 · size), old (rows, size) → deter (rows, size), and the same in T, its rows short_stride apart; null for none. Who
// asks for T gets both as exactly as T needs.
template <class T>
static void gates(const T* parts, const float* weight, const float* bias, float epsilon, const float* old, float* deter, T* shorter,
                  Index short_stride, Index rows, Index size, int threads) {
#pragma omp parallel for num_threads(threads) schedule(static) if (rows * size > WORTH_A_THREAD / 4)
    for (Index r = 0; r < rows; r++) {
        const auto work = [=](auto* its) {
            gates_of_row(parts + r * 3 * size, weight, bias, epsilon, old + r * size, deter + r * size, its, size);
        };
        if (shorter)
            work(shorter + r * short_stride);
        else
            work((float*)nullptr);
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
            const Norm norm = norm_of<float>(row, 3 * size, epsilon);
            Floats sums = all(0), products = all(0);
            // Of the normed number · its weight; and what the norm's gradient needs to know of all of them.
            auto put = [&](Index i, Index at, Floats g) {
                g = first_lanes(g * load_up_to(weight + at, size - i), size - i);
                store_up_to(of_normed.data() + at, g, size - i);
                sums += g;
                products += g * (load_up_to(row + at, size - i) - norm.mean) * norm.scale;
            };
            for (Index i = 0; i < size; i += LANES) {
                const Gates its = Gates::of<float>(row, weight, bias, norm, i, size);
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
