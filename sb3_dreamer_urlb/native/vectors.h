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

// exp(x) with a relative error of 2e-7. Below -87 and above 88 it stays what it is there.
static inline Floats exp(Floats x) {
    x = x < -87.0f ? all(-87.0f) : x;
    x = x > 88.0f ? all(88.0f) : x;
    const float MAGIC = 12582912.0f;  // 1.5 * 2^23: adding it rounds to an integer, which then stands in the lowest bits
    Floats shifted = x * 1.44269504f + MAGIC;
    Floats k = shifted - MAGIC;
    Floats r = x - k * 0.693359375f + k * 2.12194440e-4f;
    Floats p = r * 1.9875691e-4f + 1.3981999e-3f;
    p = p * r + 8.3334519e-3f;
    p = p * r + 4.1665796e-2f;
    p = p * r + 1.6666665e-1f;
    p = p * r + 0.5f;
    p = p * r * r + r + 1.0f;
    return (Floats)((Ints)p + ((Ints)shifted << 23));
}
