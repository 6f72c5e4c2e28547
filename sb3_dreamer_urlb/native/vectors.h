// Sixteen numbers at a time, read from float32 or bfloat16 and computed in float32. GCC's and clang's vector types: the
// compiler picks the instructions of the machine it runs on.
#pragma once

#include <cstdint>
#include <cstring>

#if defined(__x86_64__)
#include <immintrin.h>
#endif
#include <omp.h>

#define EXPORT extern "C" __attribute__((visibility("default")))

using Index = int64_t;
typedef float Floats __attribute__((vector_size(64)));
typedef int32_t Ints __attribute__((vector_size(64)));
typedef uint32_t Bits __attribute__((vector_size(64)));
typedef uint16_t Shorts __attribute__((vector_size(32)));

constexpr Index LANES = 16;
// Numbers below which a second thread costs more than it brings.
constexpr Index WORTH_A_THREAD = 1 << 14;

// bfloat16: the upper half of a float32.
struct BF16 {
    uint16_t bits;
};

static inline Floats all(float x) { return Floats{} + x; }

template <class T>
static inline T read(const void* p) {
    T x;
    std::memcpy(&x, p, sizeof x);
    return x;
}
static inline Floats load(const float* p) { return read<Floats>(p); }
static inline Floats load(const BF16* p) {
#ifdef __AVX512F__
    return (Floats)_mm512_slli_epi32(_mm512_cvtepu16_epi32((__m256i)read<Shorts>(p)), 16);
#else
    return (Floats)(__builtin_convertvector(read<Shorts>(p), Bits) << 16);
#endif
}

static inline void store(float* p, Floats x) { std::memcpy(p, &x, sizeof x); }
// To the nearest, ties to even; what is not a number stays so.
static inline void store(BF16* p, Floats x) {
#ifdef __AVX512BF16__
    __m256bh shorts = _mm512_cvtneps_pbh((__m512)x);
    std::memcpy(p, &shorts, sizeof shorts);
#else
    Bits bits = (Bits)x;
    Bits rounded = (bits + 0x7fff + ((bits >> 16) & 1)) >> 16;
    Bits is_nan = (Bits)(x != x);
    Shorts shorts = __builtin_convertvector((rounded & ~is_nan) | (is_nan & 0x7fc0), Shorts);
    std::memcpy(p, &shorts, sizeof shorts);
#endif
}

// The last numbers of a row, fewer than LANES; the other lanes are 0.
template <class T>
static inline Floats load(const T* p, Index count) {
    T some[LANES] = {};
    std::memcpy(some, p, count * sizeof(T));
    return load(some);
}
template <class T>
static inline void store(T* p, Floats x, Index count) {
    T some[LANES];
    store(some, x);
    std::memcpy(p, some, count * sizeof(T));
}

static inline float sum(Floats x) {
    float total = 0;
    for (Index i = 0; i < LANES; i++) total += x[i];
    return total;
}

// exp(x) = 2^k · 2^f with k whole and |f| at most 1/2; the polynomial is the minimax one, off by 9e-8 of its value. Below -87
// what it is there; infinity gives NaN, as NaN does.
static inline Floats exp(Floats x) {
    const float LOG2_E = 1.44269504f;
#ifdef __AVX512F__
    x = (Floats)_mm512_max_ps(_mm512_set1_ps(-87.0f), (__m512)x);  // in this order NaN stays
    Floats k = (Floats)_mm512_roundscale_ps((__m512)(x * LOG2_E), _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC);
#else
    const float MAGIC = 12582912.0f;  // 1.5 * 2^23: adding it rounds to an integer, which then stands in the lowest bits
    x = x < -87.0f ? all(-87.0f) : x;
    Floats shifted = x * LOG2_E + MAGIC, k = shifted - MAGIC;
#endif
    Floats f = x * LOG2_E - k;
    Floats p = f * 1.32647180e-3f + 9.67151299e-3f;
    p = p * f + 5.55073395e-2f;
    p = p * f + 2.40222424e-1f;
    p = p * f + 6.93147004e-1f;
    p = p * f + 1.0f;
#ifdef __AVX512F__
    return (Floats)_mm512_scalef_ps((__m512)p, (__m512)k);
#else
    return (Floats)((Ints)p + ((Ints)shifted << 23));
#endif
}
