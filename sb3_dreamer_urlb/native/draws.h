// One class a variable, drawn by inverting the cumulative distribution of exp(logit - the variable's largest).
//
// The class is the first whose cumulative weight exceeds uniform · all weights. Running sums are made in pieces, so they may
// shrink by a rounding where a weight is 0: such a class is never the first.
#pragma once

#include "lanes.h"

// Sixteen logits with their bias; lanes beyond `count` are as impossible as can be.
template <class T>
static inline Floats logits_of(const T* logits, const float* bias, Index count) {
    Floats x = load_up_to(logits, count);
    if (bias) x += load_up_to(bias, count);
    if (count < LANES) {
        for (Index i = count; i < LANES; i++) x[i] = -__builtin_inff();
    }
    return x;
}

// One variable, with its numbers in `vectors` vectors.
template <class T>
[[gnu::always_inline]] static inline Index draw(const T* logits, const float* bias, float uniform, Floats* weights, Floats* cdf, const Index vectors,
                         const Index size, float* probs) {
    Floats most = all(-__builtin_inff());
    for (Index i = 0; i < vectors; i++) {
        weights[i] = logits_of(logits + i * LANES, bias ? bias + i * LANES : nullptr, size - i * LANES);
        most = larger(weights[i], most);
    }
    most = largest(most);
    Floats below = all(0);
    for (Index i = 0; i < vectors; i++) {
        weights[i] = exp_or_zero(weights[i] - most);
        cdf[i] = running_sum(weights[i]) + below;
        below = last(cdf[i]);
    }
    if (probs) {
        const Floats scale = 1.0f / below;
        for (Index i = 0; i < vectors; i++) store_up_to(probs + i * LANES, weights[i] * scale, size - i * LANES);
    }
    const Floats bound = below * uniform;
    // Sixty-four classes at a time: which of few it is cannot be foreseen.
    for (Index begin = 0; begin < vectors; begin += 4) {
        uint64_t found = 0;
        for (Index i = begin; i < vectors && i < begin + 4; i++) {
            found |= uint64_t(where_greater(cdf[i], bound) & where_greater(weights[i], all(0))) << (i - begin) * LANES;
        }
        if (found) return begin * LANES + __builtin_ctzll(found);
    }
    // The uniform number was rounded to 1; or there is something that is not a number, and any class will do.
    for (Index i = vectors; i-- > 0;) {
        const uint32_t possible = where_greater(weights[i], all(0));
        if (possible) return i * LANES + 31 - __builtin_clz(possible);
    }
    return 0;
}

#ifdef __AVX512DQ__
// One variable of 32 classes without its largest logit and with half the sums: where exp can hold all of its logits, as almost
// always. -1: not here.
template <class T>
[[gnu::always_inline]] static inline Index draw_of_pairs(const T* logits, const float* bias, float uniform, float* probs) {
    auto [even, odd] = Pairs::from(logits);
    if (bias) {
        const Pairs more = Pairs::from(bias);
        even += more.even, odd += more.odd;
    }
    const __m512 farthest = _mm512_range_ps((__m512)even, (__m512)odd, 0b1011);  // the larger one without its sign
    if (_mm512_cmp_ps_mask(farthest, _mm512_set1_ps(80.0f), _CMP_GT_OQ)) return -1;
    if (probs)
        even = quick_exp(even), odd = quick_exp(odd);
    else
        even = quick_exp_of<T>(even), odd = quick_exp_of<T>(odd);
    const Floats cdf = running_sum(even + odd), total = last(cdf), bound = total * uniform;
    const uint32_t found = where_greater(cdf, bound);
    if (!found) return -1;
    if (probs) {
        const Ints low = {0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23};
        const Floats scale = 1.0f / total;
        const __m512 e = (__m512)(even * scale), o = (__m512)(odd * scale);
        store(probs, (Floats)_mm512_permutex2var_ps(e, (__m512i)low, o));
        store(probs + LANES, (Floats)_mm512_permutex2var_ps(e, (__m512i)(low + 8), o));
    }
    const uint32_t place = __builtin_ctz(found), is_even = where_greater(cdf - odd, bound) >> place & 1;
    return 2 * place + 1 - is_even;
}
#endif

// Vectors of a variable of `size` classes, where it is one of the usual sizes; 0 elsewhere.
static inline int usual_vectors(Index size) { return size == 16 || size == 32 || size == 64 ? size / LANES : 0; }

// All variables of a row: logits (variables, size), bias (variables, size) or null, uniform (variables) in [0, 1) → classes
// (variables), `step` more for each variable than for the one before; probs (variables, size) or null. `room` for 2 · the vectors
// of a variable, where VECTORS is 0.
template <int VECTORS, class T>
static inline void draw_row(const T* logits, const float* bias, const float* uniform, Index* classes, float* probs, Index variables,
                            Index size, Index step, Floats* room) {
    for (Index v = 0; v < variables; v++) {
        const T* its = logits + v * size;
        const float* its_bias = bias ? bias + v * size : nullptr;
        float* its_probs = probs ? probs + v * size : nullptr;
#ifdef __AVX512DQ__
        if constexpr (VECTORS == 2) {
            const Index drawn = draw_of_pairs(its, its_bias, uniform[v], its_probs);
            classes[v] = v * step + drawn;
            if (drawn >= 0) continue;
        }
#endif
        if constexpr (VECTORS) {
            Floats weights[VECTORS], cdf[VECTORS];
            classes[v] = v * step + draw(its, its_bias, uniform[v], weights, cdf, VECTORS, VECTORS * LANES, its_probs);
        } else {
            const Index vectors = (size + LANES - 1) / LANES;
            classes[v] = v * step + draw(its, its_bias, uniform[v], room, room + vectors, vectors, size, its_probs);
        }
    }
}
