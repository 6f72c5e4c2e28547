// Draws from logits (draws.h) for all rows, one-hot vectors of what was drawn, and the gradient of probabilities.

#include "draws.h"

#include <vector>

template <int VECTORS, class T>
static void draws(const T* logits, const float* bias, const float* uniform, Index* classes, float* probs, Index rows, Index variables,
                  Index size, Index step, int threads) {
#pragma omp parallel num_threads(threads) if (rows * variables * size > WORTH_A_THREAD)
    {
        std::vector<Floats> room(VECTORS ? 0 : 2 * ((size + LANES - 1) / LANES));
#pragma omp for schedule(static)
        for (Index r = 0; r < rows; r++) {
            const Index place = r * variables;
            draw_row<VECTORS>(logits + place * size, bias, uniform + place, classes + place, probs ? probs + place * size : nullptr,
                              variables, size, step, room.data());
        }
    }
}

// logits (rows, variables, size), bias (variables, size) or null, uniform (rows, variables) in [0, 1) → classes (rows, variables),
// `step` more for each variable than for the one before; probs (rows, variables, size) or null for none.
#define FOR(T, NAME)                                                                                                       \
    EXPORT void draws_##NAME(const T* logits, const float* bias, const float* uniform, Index* classes, float* probs,       \
                             Index rows, Index variables, Index size, Index step, int threads) {                           \
        const int vectors = usual_vectors(size);                                                                           \
        auto its = vectors == 2 ? draws<2, T> : vectors == 1 ? draws<1, T> : vectors == 4 ? draws<4, T> : draws<0, T>;     \
        its(logits, bias, uniform, classes, probs, rows, variables, size, step, threads);                                  \
    }
FOR(float, float)
FOR(BF16, bfloat16)

// out (rows, size) ← 1 at each row's class, 0 elsewhere.
template <class T>
static void one_hot(const Index* classes, T* out, T one, Index rows, Index size, int threads) {
#pragma omp parallel for num_threads(threads) if (rows * size > WORTH_A_THREAD) schedule(static)
    for (Index r = 0; r < rows; r++) {
        std::memset(out + r * size, 0, size * sizeof(T));
        out[r * size + classes[r]] = one;
    }
}

EXPORT void one_hot_float(const Index* classes, float* out, Index rows, Index size, int threads) {
    one_hot(classes, out, 1.0f, rows, size, threads);
}
EXPORT void one_hot_bfloat16(const Index* classes, BF16* out, Index rows, Index size, int threads) {
    one_hot(classes, out, BF16{0x3f80}, rows, size, threads);
}

// out ← probs · (grad - the mean of grad under probs), each row of `size` for itself: the gradient of a softmax.
template <class T>
static void softmax_backward(const T* grad, const float* probs, T* out, Index rows, Index size, int threads) {
#pragma omp parallel for num_threads(threads) if (rows * size > WORTH_A_THREAD) schedule(static)
    for (Index r = 0; r < rows; r++) {
        const Index begin = r * size, whole = size / LANES * LANES;
        Floats sums = all(0);
        for (Index i = begin; i < begin + whole; i += LANES) sums += load(grad + i) * load(probs + i);
        if (whole < size) sums += load_up_to(grad + begin + whole, size - whole) * load_up_to(probs + begin + whole, size - whole);
        const float mean = total(sums);
        for (Index i = begin; i < begin + whole; i += LANES) store(out + i, load(probs + i) * (load(grad + i) - mean));
        if (whole < size) {
            const Floats p = load_up_to(probs + begin + whole, size - whole);
            store_up_to(out + begin + whole, p * (load_up_to(grad + begin + whole, size - whole) - mean), size - whole);
        }
    }
}

EXPORT void softmax_backward_float(const float* grad, const float* probs, float* out, Index rows, Index size, int threads) {
    softmax_backward(grad, probs, out, rows, size, threads);
}
EXPORT void softmax_backward_bfloat16(const BF16* grad, const float* probs, BF16* out, Index rows, Index size, int threads) {
    softmax_backward(grad, probs, out, rows, size, threads);
}

// Whether the draws, sums and gates are made for this processor; elsewhere they are right, but slow.
EXPORT int has_lanes() {
#ifdef __AVX512DQ__
    return 1;
#else
    return 0;
#endif
}
