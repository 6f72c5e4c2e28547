// ELU in place behind a product without its bias, and its gradient together with that of the bias.

#include "activation.h"

// x ← ELU(x + bias), x (rows, columns); no bias: null.
template <class T>
static void bias_elu(T* x, const T* bias, Index rows, Index columns, int threads) {
    if (!bias) columns *= rows, rows = 1;
    // Pieces of about a page, so that one long row is shared out, too.
    const Index piece = bias ? columns : 4096, pieces = bias ? rows : (columns + piece - 1) / piece;
#pragma omp parallel for num_threads(threads) if (rows * columns > WORTH_A_THREAD)
    for (Index r = 0; r < pieces; r++) {
        T* row = x + r * piece;
        const Index size = bias ? columns : (columns - r * piece < piece ? columns - r * piece : piece);
        Index i = 0;
        for (; i + LANES <= size; i += LANES) {
            Floats y = load(row + i);
            store(row + i, elu_in<T>(bias ? y + load(bias + i) : y));
        }
        if (i < size) {
            Floats y = load(row + i, size - i);
            store(row + i, elu_in<T>(bias ? y + load(bias + i, size - i) : y), size - i);
        }
    }
}

// out ← gradient · ELU'(where the output is y); sums (threads, period) of out by place in the period, null for none.
template <class T>
static void elu_backward(const T* grad, const T* y, T* out, float* sums, Index size, Index period, int threads) {
    const Index periods = (size + period - 1) / period;
#pragma omp parallel num_threads(threads) if (sums || size > WORTH_A_THREAD)
    {
        const Index me = omp_get_thread_num(), all_of_us = omp_get_num_threads();
        float* mine = sums ? sums + me * period : nullptr;
        const Index begin = periods * me / all_of_us, end = periods * (me + 1) / all_of_us;
        for (Index r = begin; r < end; r++) {
            const Index first = r * period, length = size - first < period ? size - first : period;
            Index i = 0;
            for (; i + LANES <= length; i += LANES) {
                Floats g = load(grad + first + i) * elu_slope(load(y + first + i));
                store(out + first + i, g);
                if (mine) store(mine + i, load(mine + i) + g);
            }
            if (i < length) {
                Floats g = load(grad + first + i, length - i) * elu_slope(load(y + first + i, length - i));
                store(out + first + i, g, length - i);
                if (mine) store(mine + i, load(mine + i, length - i) + g, length - i);
            }
        }
    }
}

#define FOR(T, NAME)                                                                                                   \
    EXPORT void bias_elu_##NAME(T* x, const T* bias, Index rows, Index columns, int threads) {                         \
        bias_elu(x, bias, rows, columns, threads);                                                                     \
    }                                                                                                                  \
    EXPORT void elu_backward_##NAME(const T* grad, const T* y, T* out, float* sums, Index size, Index period, int threads) { \
        elu_backward(grad, y, out, sums, size, period, threads);                                                       \
    }
FOR(float, float)
FOR(BF16, bfloat16)
