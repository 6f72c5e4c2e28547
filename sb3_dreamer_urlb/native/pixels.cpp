// Images between bytes and numbers, and how far decoded ones are from them.

#include "vectors.h"

// 16 bytes as numbers, divided by `range`, minus one half.
static inline Floats scaled(const uint8_t* bytes, float range) {
    Floats x;
#ifdef __AVX512F__
    x = (Floats)_mm512_cvtepi32_ps(_mm512_cvtepu8_epi32(_mm_loadu_si128((const __m128i*)bytes)));
#else
    for (Index i = 0; i < LANES; i++) x[i] = bytes[i];
#endif
    return x / range - 0.5f;
}

// Numbers of 16 pixels, three colours one after the other, from one row of bytes a colour.
static inline void interleave(const uint8_t* red, Index plane, uint8_t* out) {
    for (Index i = 0; i < LANES; i++) {
        out[3 * i] = red[i];
        out[3 * i + 1] = red[plane + i];
        out[3 * i + 2] = red[2 * plane + i];
    }
}

// Bytes (images, channels, pixels), or (images, pixels, channels) if `last` → numbers (images, pixels, channels).
EXPORT void scale_images(const uint8_t* bytes, Index images, Index channels, Index pixels, int last, float range, float* out,
                         int threads) {
    const Index size = channels * pixels;
#pragma omp parallel for num_threads(threads) if (images * size > WORTH_A_THREAD)
    for (Index i = 0; i < images; i++) {
        const uint8_t* from = bytes + i * size;
        float* to = out + i * size;
        Index n = 0;
        if (last) {
            for (; n + LANES <= size; n += LANES) store(to + n, scaled(from + n, range));
            for (; n < size; n++) to[n] = from[n] / range - 0.5f;
            continue;
        }
        Index p = 0;
        uint8_t some[3 * LANES];
        for (; channels == 3 && p + LANES <= pixels; p += LANES) {
            interleave(from + p, pixels, some);
            for (Index j = 0; j < 3; j++) store(to + 3 * p + j * LANES, scaled(some + j * LANES, range));
        }
        for (; p < pixels; p++)
            for (Index c = 0; c < channels; c++) to[p * channels + c] = from[c * pixels + p] / range - 0.5f;
    }
}

constexpr Index PIECE = 8192;  // numbers summed at a time

// difference ← mean − target, and the sum of its squares, one for each piece.
template <class T>
static void distance(const T* mean, const float* target, Index size, T* difference, double* sums, int threads) {
    const Index pieces = (size + PIECE - 1) / PIECE;
#pragma omp parallel for schedule(static) num_threads(threads) if (size > WORTH_A_THREAD)
    for (Index p = 0; p < pieces; p++) {
        const Index end = size - p * PIECE < PIECE ? size : (p + 1) * PIECE;
        Floats squares[4] = {};
        Index i = p * PIECE;
        for (; i + 4 * LANES <= end; i += 4 * LANES) {
            for (Index j = 0; j < 4; j++) {
                const Index at = i + j * LANES;
                Floats d = load(mean + at) - load(target + at);
                store(difference + at, d);
                squares[j] += d * d;
            }
        }
        for (; i < end; i += LANES) {
            const Index count = end - i < LANES ? end - i : LANES;
            Floats d = load(mean + i, count) - load(target + i, count);
            store(difference + i, d, count);
            squares[0] += d * d;
        }
        sums[p] = sum((squares[0] + squares[1]) + (squares[2] + squares[3]));
    }
}

#define FOR(T, NAME)                                                                                                   \
    EXPORT void distance_##NAME(const T* mean, const float* target, Index size, T* difference, double* sums, int threads) { \
        distance(mean, target, size, difference, sums, threads);                                                       \
    }
FOR(float, float)
FOR(BF16, bfloat16)
