// Layers that read ones at known places (gather.h), for all states.

#include "gather.h"

template <class T, class U>
static void gather(const SparseLayer<T>& layer, const Index* classes, const float* x, Index x_stride, const U* addend, U* out,
                   Index out_stride, Index n, int threads) {
#pragma omp parallel for num_threads(threads) schedule(static) if (n * layer.width > WORTH_A_THREAD / 16)
    for (Index r = 0; r < n; r++) {
        sum_row(layer, classes + r * layer.variables, x + r * x_stride, addend ? addend + r * layer.width : nullptr, out + r * out_stride);
    }
}

// out (n, width), out_stride apart ← Σ rows[classes] + Σ x · others + bias + addend, then ELU if asked for; classes (n, variables), x
// (n, count), addend (n, width) or null, bias (stride) or null. rows, others and bias hold whole lines of 64 bytes.
#define FOR(T, U, NAME)                                                                                                        \
    EXPORT void gather_##NAME(const T* rows, const Index* classes, Index variables, const T* others, const float* x, Index count, \
                              Index x_stride, const T* bias, const U* addend, U* out, Index out_stride, Index n, Index width,  \
                              Index stride, int with_elu, int threads) {                                                       \
        gather(SparseLayer<T>{rows, others, bias, variables, count, stride, width, with_elu != 0}, classes, x, x_stride, addend, out, \
               out_stride, n, threads);                                                                                        \
    }
FOR(float, float, float)
FOR(BF16, BF16, bfloat16)
#ifdef __AVX512FP16__
FOR(Half, BF16, half)
EXPORT int has_halves() { return 1; }
#endif
