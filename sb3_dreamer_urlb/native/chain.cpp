// Dense layers one after the other (chain.h), for all rows.

#include "chain.h"

#ifdef HAS_TILES

template <class T, class Out>
static void chain(const T* x, Index stride, Index rows, const T* plus, Index plus_stride, const ChainLayer* layers, Index count, Out* out,
                  int threads) {
    const Index widest = widest_of(layers, count), outputs = layers[count - 1].outputs;
    by_blocks(rows, PANEL, threads, [=] { return Between<T>(widest); }, [=](const Between<T>& between, Index r, Index height) {
        between.chain(x + r * stride, stride, height, plus ? plus + r * plus_stride : nullptr, plus_stride, layers, count,
                      out + r * outputs, outputs);
    });
}

#define FOR(T, OUT, NAME)                                                                                              \
    EXPORT void chain_##NAME(const T* x, Index stride, Index rows, const T* plus, Index plus_stride, const ChainLayer* layers, \
                             Index count, OUT* out, int threads) {                                                     \
        chain(x, stride, rows, plus, plus_stride, layers, count, out, threads);                                        \
    }
FOR(float, float, float)
FOR(BF16, float, bfloat16)
FOR(BF16, BF16, short)

#endif
