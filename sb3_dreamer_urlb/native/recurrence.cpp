// What the GRU does behind its product: a layer norm over all three parts, two gates, a candidate, the new state.

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

// parts (rows, 3 · size) in the order reset, update, candidate, before their norm with weight and bias (3 · size); old (rows,
// size) → deter (rows, size), and the same in T, its rows short_stride apart.
template <class T>
static void recurrence(const T* parts, const float* weight, const float* bias, float epsilon, const float* old, float* deter, T* shorter,
                       Index short_stride, Index rows, Index size, int threads) {
#pragma omp parallel for num_threads(threads) schedule(static) if (rows * size > WORTH_A_THREAD / 4)
    for (Index r = 0; r < rows; r++) {
        const T* row = parts + r * 3 * size;
        const float mean = sum_of(row, 3 * size, [](Floats x) { return x; }) / (3 * size);
        const float variance = sum_of(row, 3 * size, [mean](Floats x) { return (x - mean) * (x - mean); }) / (3 * size);
        const float scale = 1.0f / __builtin_sqrtf(variance + epsilon);
        auto normed = [&](Index i, Index count) {
            return (load_up_to(row + i, count) - mean) * scale * load_up_to(weight + i, count) + load_up_to(bias + i, count);
        };
        for (Index i = 0; i < size; i += LANES) {
            const Index count = size - i;
            const Floats reset = normed(i, count), update = normed(size + i, count), candidate = normed(2 * size + i, count);
            const Floats before = load_up_to(old + r * size + i, count);
            const Floats now = before + sigmoid(update) * (tanh(sigmoid(reset) * candidate) - before);
            store_up_to(deter + r * size + i, now, count);
            store_up_to(shorter + r * short_stride + i, now, count);
        }
    }
}

#define FOR(T, NAME)                                                                                                       \
    EXPORT void recurrence_##NAME(const T* parts, const float* weight, const float* bias, float epsilon, const float* old, \
                                  float* deter, T* shorter, Index short_stride, Index rows, Index size, int threads) {     \
        recurrence(parts, weight, bias, epsilon, old, deter, shorter, short_stride, rows, size, threads);                  \
    }
FOR(float, float)
FOR(BF16, bfloat16)
