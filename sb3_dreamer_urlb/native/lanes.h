// What kernels need of sixteen numbers besides vectors.h: some of them, sums of lanes, exponentials and what is made of them.
#pragma once

#include <type_traits>

#include "activation.h"

// The first `count` lanes, 0 in the others; 16 or more: all.
static inline Floats first_lanes(Floats x, Index count) {
    const Ints lane = {0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15};
    return lane < (int32_t)count ? x : all(0);
}

// Sixteen numbers, or as many as there are left in a row: without a detour through memory where the processor can.
#ifdef __AVX512BW__
static inline __mmask16 lanes(Index count) { return count >= LANES ? 0xffff : (1 << count) - 1; }
static inline Floats load_up_to(const float* p, Index count) { return (Floats)_mm512_maskz_loadu_ps(lanes(count), p); }
static inline Floats load_up_to(const BF16* p, Index count) {
    const __m256i shorts = _mm256_maskz_loadu_epi16(lanes(count), p);
    return (Floats)_mm512_slli_epi32(_mm512_cvtepu16_epi32(shorts), 16);
}
static inline void store_up_to(float* p, Floats x, Index count) { _mm512_mask_storeu_ps(p, lanes(count), (__m512)x); }
static inline void store_up_to(BF16* p, Floats x, Index count) {
    BF16 some[LANES];
    store(some, x);
    _mm256_mask_storeu_epi16(p, lanes(count), read<__m256i>(some));
}
#else
template <class T>
static inline Floats load_up_to(const T* p, Index count) {
    return count >= LANES ? load(p) : load(p, count);
}
template <class T>
static inline void store_up_to(T* p, Floats x, Index count) {
    if (count >= LANES) store(p, x);
    else store(p, x, count);
}
#endif

// Each lane's number and those of all lanes before it.
static inline Floats running_sum(Floats x) {
#ifdef __AVX512F__
    const __m512i none = _mm512_setzero_si512();
    x += (Floats)_mm512_alignr_epi32((__m512i)x, none, 15);
    x += (Floats)_mm512_alignr_epi32((__m512i)x, none, 14);
    x += (Floats)_mm512_alignr_epi32((__m512i)x, none, 12);
    return x + (Floats)_mm512_alignr_epi32((__m512i)x, none, 8);
#else
    for (Index i = 1; i < LANES; i++) x[i] += x[i - 1];
    return x;
#endif
}

static inline Floats larger(Floats x, Floats y) { return x > y ? x : y; }

// The largest of all lanes, in each of them. What is not a number may or may not count.
static inline Floats largest(Floats x) {
#ifdef __AVX512F__
    x = larger(x, (Floats)_mm512_shuffle_f32x4((__m512)x, (__m512)x, 0x4e));
    x = larger(x, (Floats)_mm512_shuffle_f32x4((__m512)x, (__m512)x, 0xb1));
    x = larger(x, (Floats)_mm512_permute_ps((__m512)x, 0x4e));
    return larger(x, (Floats)_mm512_permute_ps((__m512)x, 0xb1));
#else
    float most = x[0];
    for (Index i = 1; i < LANES; i++) most = x[i] > most ? x[i] : most;
    return all(most);
#endif
}

// The sum of all lanes, pair by pair.
static inline float total(Floats x) {
#ifdef __AVX512F__
    return _mm512_reduce_add_ps((__m512)x);
#else
    return sum(x);
#endif
}

static inline Floats last(Floats x) {
#ifdef __AVX512F__
    return (Floats)_mm512_permutexvar_ps(_mm512_set1_epi32(15), (__m512)x);
#else
    return all(x[15]);
#endif
}

// One bit a lane: those where left > right.
static inline uint32_t where_greater(Floats left, Floats right) {
#ifdef __AVX512F__
    return _mm512_cmp_ps_mask((__m512)left, (__m512)right, _CMP_GT_OQ);
#else
    uint32_t found = 0;
    for (Index i = 0; i < LANES; i++) found |= uint32_t(left[i] > right[i]) << i;
    return found;
#endif
}

#ifdef __AVX512DQ__
// 2^t, with a relative error of 2e-7, in the lanes that `kept` has a bit for; 0 in the others.
static inline Floats power_of_two(Floats t, __mmask16 kept) {
    const Floats r = (Floats)_mm512_reduce_ps((__m512)t, 1);  // t - floor(t)
    Floats p = r * 1.8775761e-3f + 8.989342e-3f;
    p = p * r + 5.5826318e-2f;
    p = p * r + 2.4015361e-1f;
    p = p * r + 6.931531e-1f;
    p = p * r + 0.99999994f;
    return (Floats)_mm512_maskz_scalef_ps(kept, (__m512)p, (__m512)t);
}
#endif

// exp(x), with a relative error of 2e-7 · (1 + |x| / 2); 0 far below, infinite far above. What is not a number stays so.
static inline Floats quick_exp(Floats x) {
#ifdef __AVX512DQ__
    return power_of_two(x * 1.44269504f, 0xffff);
#else
    return exp(x);
#endif
}

// The same as exactly as numbers of a format need it.
template <class T>
static inline Floats quick_exp_of(Floats x) {
#ifdef __AVX512DQ__
    if constexpr (std::is_same_v<T, BF16>) return coarse_power_of_two(x * 1.44269504f);
#endif
    return quick_exp(x);
}

// exp(x) where x ≤ 0, but 0 below -87: what cannot be must not be drawn. What is not a number stays so.
static inline Floats exp_or_zero(Floats x) {
#ifdef __AVX512DQ__
    return power_of_two(x * 1.44269504f, _mm512_cmp_ps_mask((__m512)x, _mm512_set1_ps(-87.0f), _CMP_NLT_UQ));
#else
    return x >= -87.0f ? exp(x) : x == x ? all(0) : x;
#endif
}

// 1 / (1 + exp(x)); exp stays what it is at 80 beyond. `T`: the format of what x was made of, which says how exact it need be.
template <class T>
static inline Floats reciprocal_of_one_plus_exp(Floats x) {
#ifdef __AVX512DQ__
    if constexpr (std::is_same_v<T, BF16>) return (Floats)_mm512_rcp14_ps((__m512)(coarse_power_of_two(x * 1.44269504f) + 1.0f));
#endif
    x = x > 80.0f ? all(80.0f) : x;
#ifdef __AVX512DQ__
    const Floats y = power_of_two(x * 1.44269504f, 0xffff) + 1.0f, z = (Floats)_mm512_rcp14_ps((__m512)y);
    return z * (2.0f - y * z);
#else
    return 1.0f / (exp(x) + 1.0f);
#endif
}

template <class T>
static inline Floats sigmoid(Floats x) {
    return reciprocal_of_one_plus_exp<T>(-x);
}
template <class T>
static inline Floats tanh(Floats x) {
    return 1.0f - 2.0f * reciprocal_of_one_plus_exp<T>(x + x);
}

#ifdef __AVX512DQ__
// Thirty-two numbers, those at even places and those at odd ones.
struct Pairs {
    Floats even, odd;
    static Pairs from(const BF16* p) { return from(read<__m512i>(p)); }
    static Pairs from(__m512i both) {
        return {(Floats)_mm512_slli_epi32(both, 16), (Floats)_mm512_and_si512(both, _mm512_set1_epi32(0xffff0000))};
    }
    static Pairs from(const float* p) {
        const Ints places = {0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30};
        const __m512 low = (__m512)load(p), high = (__m512)load(p + LANES);
        return {(Floats)_mm512_permutex2var_ps(low, (__m512i)places, high),
                (Floats)_mm512_permutex2var_ps(low, (__m512i)(places + 1), high)};
    }
};
#endif
