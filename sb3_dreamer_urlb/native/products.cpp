// Products of a layer with many rows, on tiles (tiles.h): rows · weights with what follows them, and the gradient of weights.

#include <cstdlib>

#include <sys/syscall.h>
#include <unistd.h>

#include "behind.h"
#include "transposed.h"

#ifdef HAS_TILES

EXPORT int has_tiles() {
    const long REQUEST = 0x1023, TILE_DATA = 18;  // ARCH_REQ_XCOMP_PERM, XFEATURE_XTILEDATA
    return syscall(SYS_arch_prctl, REQUEST, TILE_DATA) == 0;
}

// -- rows · weights ---------------------------------------------------------------------------------------------------

// Weights (outputs, depth), or (depth, outputs) if by_depth, as the right operand.
template <class T>
static void lay_out_weights(const T* weight, Index stride, Index outputs, Index depth, bool by_depth, uint16_t* out, int threads) {
    const Index panels = (outputs + PANEL - 1) / PANEL, panel = laid_size<T>(PANEL, depth);
#pragma omp parallel for num_threads(threads) if (outputs * depth > WORTH_A_THREAD)
    for (Index p = 0; p < panels; p++) {
        const Index some = least(outputs - p * PANEL, PANEL);
        if (by_depth)
            lay_out_by_depth(weight + p * PANEL, stride, some, depth, out + p * panel);
        else
            lay_out_right(weight + p * PANEL * stride, stride, some, depth, out + p * panel);
    }
}

// Rows of whole steps that begin with a line of the cache can be read as they are. What stood behind others, up to a step, would
// meet weights of 0, which makes nothing of a number, but NaN of what is none.
static inline bool fits(const BF16* x, Index stride, Index rows, Index depth) {
    return rows >= PANEL && depth % DEPTH == 0 && stride % DEPTH == 0 && (uintptr_t)x % 64 == 0;
}
static inline bool fits(const float*, Index, Index, Index) { return false; }

static inline Left as_it_is(const BF16* x, Index stride) { return Left(x, stride); }
static inline Left as_it_is(const float* x, Index) { return Left((const uint16_t*)x, 3); }  // never

template <class T, class Out>
static void rows_by_weights(const T* x, Index stride, Index rows, Index depth, const uint16_t* weights, Index outputs,
                            const Behind<Out>& behind, int threads) {
    const Index steps = steps_of(depth), blocks = (rows + PANEL - 1) / PANEL;
#pragma omp parallel num_threads(least(threads, blocks))
    {
        static thread_local Scratch scratch;
        uint16_t* laid = (uint16_t*)scratch.get(laid_size<T>(PANEL, depth) * sizeof(uint16_t));
        Tiles tiles;
#pragma omp for schedule(static)
        for (Index block = 0; block < blocks; block++) {
            const Index r = block * PANEL, height = least(rows - r, PANEL);
            const bool as_is = fits(x, stride, height, depth);
            if (!as_is) lay_out_left(x + r * stride, stride, height, depth, laid);
            const Left left = as_is ? as_it_is(x + r * stride, stride) : Left(laid, PARTS<T>);
            block_by_weights<T>(left, weights, steps, outputs, r, height, behind);
        }
    }
}

// -- the gradient of weights ------------------------------------------------------------------------------------------

#define FOR(T, NAME)                                                                                                   \
    EXPORT void lay_out_weights_##NAME(const T* weight, Index stride, Index outputs, Index depth, int by_depth, uint16_t* out, \
                                       int threads) {                                                                  \
        lay_out_weights(weight, stride, outputs, depth, by_depth, out, threads);                                       \
    }                                                                                                                  \
    EXPORT void transposed_product_##NAME(const T* left, Index left_stride, const T* right, Index right_stride, float* sums, \
                                          float* out, Index rows, Index m, Index n, int threads) {                     \
        transposed_product(left, left_stride, PlainRows<T>{right, right_stride}, sums, out, rows, m, n, 1, threads);    \
    }
FOR(float, float)
FOR(BF16, bfloat16)

#define PRODUCT(T, NAME)                                                                                          \
    EXPORT void rows_by_weights_##NAME(const T* x, Index stride, Index rows, Index depth, const uint16_t* weights,      \
                                       Index outputs, const float* bias, int elu, T* out, Index out_stride, int threads) { \
        Behind<T> behind{bias, nullptr, 0, (bool)elu, out, out_stride};                                              \
        rows_by_weights(x, stride, rows, depth, weights, outputs, behind, threads);                                    \
    }
PRODUCT(float, float)
PRODUCT(BF16, bfloat16)

#else

EXPORT int has_tiles() { return 0; }

#endif
