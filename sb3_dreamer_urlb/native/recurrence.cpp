// What the GRU does behind its product: a layer norm over all three parts, two gates, a candidate, the new state.

#include "lanes.h"

// Lanes of sixteen from `done` on.
static inline Floats from_lane(Floats x, Index done) {
    const Ints lane = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    return lane >= (int32_t)done ? x : all(0);
}

// The sum of some function of `size` ≥ 16 numbers; four sums at a time, because each addition waits for the one before.
template <class T, class F>
static inline float sum_of(const T* x, Index size, F of) {
    Floats sums[4] = {};
    const Index tail = size % LANES, whole = size - tail;
    Index i = 0;
    for (; i + 4 * LANES <= whole; i += 4 * LANES) {
        for (Index j = 0; j < 4; j++) sums[j] += of(load(x + i + j * LANES));
    }
    for (; i < whole; i += LANES) sums[0] += of(load(x + i));
    if (tail) sums[1] += from_lane(of(load(x + size - LANES)), LANES - tail);
    return total((sums[0] + sums[1]) + (sums[2] + sums[3]));
}

// parts (rows, 3 · size) in the order reset, update, candidate, before their norm with weight and bias (3 · size); old (rows,
// size), old_stride apart → deter (rows, size), and the same in T, short_stride apart. size ≥ 16.
template <class T>
static void recurrence(const T* parts, const float* weight, const float* bias, float epsilon, const float* old, float* deter, T* shorter,
                       Index short_stride, Index rows, Index size, int threads) {
#pragma omp parallel for num_threads(threads) schedule(static) if (rows * size > WORTH_A_THREAD / 4)
    for (Index r = 0; r < rows; r++) {
        const T* row = parts + r * 3 * size;
        const float mean = sum_of(row, 3 * size, [](Floats x) { return x; }) / (3 * size);
        const float variance = sum_of(row, 3 * size, [mean](Floats x) { return (x - mean) * (x - mean); }) / (3 * size);
        const float scale = 1.0f / __builtin_sqrtf(variance + epsilon);
        for (Index next = 0; next < size; next += LANES) {
            // The last sixteen may be some of those before once more.
            const Index i = next < size - LANES ? next : size - LANES;
            Floats part[3];
            for (Index p = 0; p < 3; p++) {
                const Index j = p * size + i;
                part[p] = (load(row + j) - mean) * scale * load(weight + j) + load(bias + j);
            }
            const Floats candidate = tanh(sigmoid(part[0]) * part[2]), before = load(old + r * size + i);
            const Floats now = before + sigmoid(part[1]) * (candidate - before);
            store(deter + r * size + i, now);
            store(shorter + r * short_stride + i, now);
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
