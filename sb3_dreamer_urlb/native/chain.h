// Dense layers one after the other, for 32 rows at a time: what is between them never leaves the nearest caches.
#pragma once

#include "behind.h"

#ifdef HAS_TILES

struct ChainLayer {
    const uint16_t* weights;  // laid out
    const float* bias;
    Index depth, outputs;
};

static inline Index widest_of(const ChainLayer* layers, Index count) {
    Index widest = 0;
    for (Index l = 0; l < count; l++) {
        widest = layers[l].depth > widest ? layers[l].depth : widest;
        widest = layers[l].outputs > widest ? layers[l].outputs : widest;
    }
    return widest;
}

static inline Left left_of(const BF16* x, Index stride, Index, Index, uint16_t*) { return Left(x, stride); }
static inline Left left_of(const float* x, Index stride, Index rows, Index depth, uint16_t* laid) {
    lay_out_left(x, stride, rows, depth, laid);
    return Left(laid, PARTS<float>);
}

// What is between the layers of one thread.
template <class T>
struct Between {
    T* numbers;
    Index room;
    uint16_t* laid;

    explicit Between(Index widest) : room(PANEL * up_to(widest, PANEL)) {
        static thread_local Scratch its_numbers, others;
        numbers = (T*)its_numbers.get(2 * room * sizeof(T));
        laid = (uint16_t*)others.get(laid_size<T>(PANEL, widest) * sizeof(uint16_t));
    }

    // x (height, depth of the first layer), at most 32 rows → out (height, outputs of the last one). ELU behind all layers but the
    // last one; plus (height, outputs of the first) is added to what the first one gives, null for none.
    template <class Out>
    void chain(const T* x, Index stride, Index height, const T* plus, Index plus_stride, const ChainLayer* layers, Index count, Out* out,
               Index out_stride) const {
        lay_out_left(x, stride, height, layers[0].depth, laid);
        Left left(laid, PARTS<T>);
        for (Index l = 0; l < count; l++, plus = nullptr) {
            const ChainLayer& layer = layers[l];
            const Index steps = steps_of(layer.depth);
            if (l + 1 == count) {
                const Behind<Out, T> behind{layer.bias, plus, plus_stride, false, out, out_stride};
                block_by_weights<T>(left, layer.weights, steps, layer.outputs, 0, height, behind);
                break;
            }
            T* its = numbers + l % 2 * room;
            const Index width = up_to(layer.outputs, PANEL);
            const Behind<T> behind{layer.bias, plus, plus_stride, true, its, width};
            block_by_weights<T>(left, layer.weights, steps, layer.outputs, 0, height, behind);
            // What stands behind a row meets weights of 0, but must be a number.
            for (Index i = 0; i < height; i++) std::memset(its + i * width + layer.outputs, 0, (width - layer.outputs) * sizeof(T));
            left = left_of(its, width, height, layer.outputs, laid);
        }
    }
};

// Calls work(first row, rows) with at most `most` rows at a time; threads share the rows as evenly as tiles allow. Each has `make`
// something of its own for work to use.
template <class Make, class Work>
static void by_blocks(Index rows, Index most, int threads, Make make, Work work) {
#pragma omp parallel num_threads(useful_threads(rows, threads))
    {
        auto mine = make();
        Tiles shaped;
        const Share its(rows);
        for (Index r = its.begin; r < its.end; r += most) work(mine, r, least(its.end - r, most));
    }
}

#endif
