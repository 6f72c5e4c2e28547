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
    const Index panels = panels_of(outputs), panel = laid_size<T>(PANEL, depth);
#pragma omp parallel for num_threads(threads) if (outputs * depth > WORTH_A_THREAD)
    for (Index p = 0; p < panels; p++) {
        const Index some = least(outputs - p * PANEL, PANEL);
        if (by_depth)
            lay_out_by_depth(weight + p * PANEL, stride, some, depth, out + p * panel);
        else
            lay_out_right(weight + p * PANEL * stride, stride, some, depth, out + p * panel);
    }
}

// Some rows of the left operand. Rows of whole steps that begin with a line of the cache are read as they are, others are laid out.
// What stood behind rows, up to a step, would meet weights of 0, which makes nothing of a number, but NaN of what is none.
template <class T>
struct LeftBlocks {
    static constexpr Index MOST = 4;

    LeftRows<T> panels[MOST];
    bool as_is[MOST];
    Index count = 0, now = 0;

    LeftBlocks(const T* x, Index stride, Index rows, Index depth, uint16_t* room) {
        const bool lines = depth % DEPTH == 0 && stride % DEPTH == 0 && (uintptr_t)x % 64 == 0;
        for (Index r = 0; r < rows; r += PANEL, count++, room += laid_size<T>(PANEL, depth)) {
            panels[count] = {x + r * stride, stride, least(rows - r, PANEL), depth, room};
            as_is[count] = PARTS<T> == 1 && lines && rows - r >= PANEL;
        }
    }
    Index bits() const {
        Index all = 0;
        for (Index i = 0; i < count; i++) all += as_is[i] ? 0 : panels[i].bits();
        return all;
    }
    void lay_out_a_bit() {
        while (as_is[now] || panels[now].row_of == PANEL) now++;
        panels[now].lay_out_a_bit();
    }
    Left operator[](Index i) const {
        return as_is[i] ? Left((const BF16*)panels[i].x, panels[i].stride) : Left(panels[i].out, PARTS<T>);
    }
};

// Rows that meet a panel of weights one after the other: more than 32 where the weights are more than a core's cache holds.
template <class T>
static inline Index rows_at_once(Index depth, Index outputs) {
    const Index CACHE = 1 << 20, bytes = laid_size<T>(PANEL, depth) * sizeof(uint16_t);
    return PANEL * (bytes * panels_of(outputs) < CACHE ? 1 : bytes <= CACHE / 8 ? 4 : bytes <= CACHE / 4 ? 2 : 1);
}

// While some rows are multiplied, the next ones are laid out.
template <class T, class Out>
static void rows_by_weights(const T* x, Index stride, Index rows, Index depth, const uint16_t* weights, Index outputs,
                            const Behind<Out>& behind, int threads) {
    const Index steps = steps_of(depth), most = rows_at_once<T>(depth, outputs), room = most / PANEL * laid_size<T>(PANEL, depth);
#pragma omp parallel num_threads(useful_threads(rows, threads))
    {
        static thread_local Scratch scratch;
        uint16_t* laid = (uint16_t*)scratch.get(2 * room * sizeof(uint16_t));
        const Share its(rows);
        const auto blocks = [&](Index r) {
            return LeftBlocks<T>(x + r * stride, stride, least(its.end - r, most), depth, laid + (r - its.begin) / most % 2 * room);
        };
        Tiles tiles;
        LeftBlocks<T> now = blocks(its.begin);
        for (Index i = now.bits(); i > 0; i--) now.lay_out_a_bit();
        for (Index r = its.begin; r < its.end; r += most) {
            const Index height = least(its.end - r, most);
            LeftBlocks<T> next = blocks(r + most);
            Pace pace = {next.bits(), calls_of<T>(height, steps, outputs)};
            const auto meanwhile = [&] { pace([&] { next.lay_out_a_bit(); }); };
            if (most == PANEL)
                blocks_by_weights<T, LEFT_STAYS>([&](Index i) { return now[i]; }, height, weights, steps, outputs, r, behind, meanwhile);
            else
                blocks_by_weights<T, RIGHT_STAYS>([&](Index i) { return now[i]; }, height, weights, steps, outputs, r, behind, meanwhile);
            now = next;
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
