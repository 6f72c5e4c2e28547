// Dense layers one after the other, for 32 rows at a time: what is between them never leaves the nearest caches.

#include "behind.h"

#ifdef HAS_TILES

struct ChainLayer {
    const uint16_t* weights;  // laid out
    const float* bias;
    Index depth, outputs;
};

static inline Left left_of(const BF16* x, Index stride, Index, Index, uint16_t*) { return Left(x, stride); }
static inline Left left_of(const float* x, Index stride, Index rows, Index depth, uint16_t* laid) {
    lay_out_left(x, stride, rows, depth, laid);
    return Left(laid, PARTS<float>);
}

// ELU behind all layers but the last one; plus (rows, outputs of the first) is added to what the first one gives, null for none.
template <class T, class Out>
static void chain(const T* x, Index stride, Index rows, const T* plus, Index plus_stride, const ChainLayer* layers, Index count, Out* out,
                  int threads) {
    const Index blocks = (rows + PANEL - 1) / PANEL;
    Index widest = 0;
    for (Index l = 0; l < count; l++) {
        widest = layers[l].depth > widest ? layers[l].depth : widest;
        widest = layers[l].outputs > widest ? layers[l].outputs : widest;
    }
#pragma omp parallel num_threads(least(threads, blocks))
    {
        static thread_local Scratch between, others;
        const Index room = PANEL * up_to(widest, PANEL);
        T* const numbers = (T*)between.get(2 * room * sizeof(T));
        uint16_t* laid = (uint16_t*)others.get(laid_size<T>(PANEL, widest) * sizeof(uint16_t));
        Tiles tiles;
#pragma omp for schedule(static)
        for (Index block = 0; block < blocks; block++) {
            const Index r = block * PANEL, height = least(rows - r, PANEL);
            lay_out_left(x + r * stride, stride, height, layers[0].depth, laid);
            Left left(laid, PARTS<T>);
            for (Index l = 0; l < count; l++) {
                const ChainLayer& layer = layers[l];
                const Index steps = steps_of(layer.depth);
                const T* its_plus = l == 0 ? plus : nullptr;
                if (l + 1 == count) {
                    const Behind<Out, T> behind{layer.bias, its_plus, plus_stride, false, out, layer.outputs};
                    block_by_weights<T>(left, layer.weights, steps, layer.outputs, r, height, behind);
                    break;
                }
                T* its = numbers + l % 2 * room;
                const Index width = up_to(layer.outputs, PANEL);
                const T* these = its_plus ? its_plus + r * plus_stride : nullptr;
                block_by_weights<T>(left, layer.weights, steps, layer.outputs, 0, height,
                                    Behind<T>{layer.bias, these, plus_stride, true, its, width});
                // What stands behind a row meets weights of 0, but must be a number.
                for (Index i = 0; i < height; i++) std::memset(its + i * width + layer.outputs, 0, (width - layer.outputs) * sizeof(T));
                left = left_of(its, width, height, layer.outputs, laid);
            }
        }
    }
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
