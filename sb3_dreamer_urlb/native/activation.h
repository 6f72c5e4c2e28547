// ELU, and its slope taken from its output.
#pragma once

#include "vectors.h"

// What is not a number passes as it is.
static inline Floats elu(Floats x) { return x <= 0.0f ? exp(x) - 1.0f : x; }

#ifdef __AVX512DQ__
// 2^t with a relative error of 2e-4, exact where t is whole: enough for what is rounded to bfloat16 next. What is not a number stays so.
static inline Floats coarse_power_of_two(Floats t) {
    const Floats f = (Floats)_mm512_reduce_ps((__m512)t, 1);  // t - floor(t)
    Floats p = f * 0.08436529f + 0.21691239f;
    p = p * f + 0.69872232f;
    p = p * f + 1.0f;
    return (Floats)_mm512_scalef_ps((__m512)p, (__m512)t);
}
#endif

// ELU of numbers that are stored in a format: in bfloat16 half of the instructions do. There it is off by 5e-4 of its value at most,
// an eighth of what the rounding may take, or by 1e-7.
template <class Out>
static inline Floats elu_in(Floats x) {
    return elu(x);
}
#ifdef __AVX512DQ__
template <>
inline Floats elu_in<BF16>(Floats x) {
    const Floats t = (Floats)_mm512_min_ps((__m512)x, _mm512_setzero_ps()) * 1.44269504f;
    return (Floats)_mm512_max_ps((__m512)(coarse_power_of_two(t) - 1.0f), (__m512)x);  // in this order NaN stays
}
#endif

static inline Floats elu_slope(Floats y) { return (y > 0.0f ? all(0) : y) + 1.0f; }
