// ELU, and its slope taken from its output.
#pragma once

#include "vectors.h"

// What is not a number passes as it is.
static inline Floats elu(Floats x) { return x <= 0.0f ? exp(x) - 1.0f : x; }

// The same, of numbers that are stored in a format: in bfloat16 half of the instructions do. The polynomial is 2^f for f from 0 to
// 1 with both ends exact; ELU is off by 5e-4 of its value at most, an eighth of what rounding to bfloat16 may take, or by 1e-7.
template <class Out>
static inline Floats elu_in(Floats x) {
    return elu(x);
}
#ifdef __AVX512DQ__
template <>
inline Floats elu_in<BF16>(Floats x) {
    const __m512 t = _mm512_mul_ps(_mm512_min_ps((__m512)x, _mm512_setzero_ps()), _mm512_set1_ps(1.44269504f));
    const Floats f = (Floats)_mm512_reduce_ps(t, 1);  // t - floor(t)
    Floats p = f * 0.08436529f + 0.21691239f;
    p = p * f + 0.69872232f;
    p = p * f + 1.0f;
    const __m512 below = _mm512_sub_ps(_mm512_scalef_ps((__m512)p, t), _mm512_set1_ps(1.0f));
    return (Floats)_mm512_max_ps(below, (__m512)x);  // in this order NaN stays
}
#endif

static inline Floats elu_slope(Floats y) { return (y > 0.0f ? all(0) : y) + 1.0f; }
