// What follows a product on tiles before its sums leave the processor.
#pragma once

#include "activation.h"
#include "tiles.h"

#ifdef HAS_TILES

// What becomes of a product: + bias (outputs,) + plus (rows, outputs), then ELU. Null: not.
template <class Out, class Plus = Out>
struct Behind {
    const float* bias;
    const Plus* plus;
    Index plus_stride;
    bool elu;
    Out* out;
    Index out_stride;

    // sums: 32 rows and 32 columns of the result; the rows from begin to end and the first columns.
    void operator()(const float* sums, Index r, Index c, Index begin, Index end, Index columns) const {
        if (columns < PANEL)
            write<true>(sums, r, c, begin, end, columns);
        else
            write<false>(sums, r, c, begin, end, columns);
    }

    template <bool some>
    void write(const float* sums, Index r, Index c, Index begin, Index end, Index columns) const {
        const Plus* its_plus = plus ? plus + r * plus_stride + c : nullptr;
        Out* its_out = out + (r + begin) * out_stride + c;
        const bool its_elu = elu;
        const __mmask32 mask = first(columns);
        const Two b = !bias ? Two{} : load_two<some>(bias + c, mask);
        for (Index i = begin; i < end; i++, its_out += out_stride) {
            Two y = {load(sums + i * PANEL) + b.low, load(sums + i * PANEL + TILE) + b.high};
            if (its_plus) {
                Two p = load_two<some>(its_plus + i * plus_stride, mask);
                y = {y.low + p.low, y.high + p.high};
            }
            if (its_elu) y = {elu_in<Out>(y.low), elu_in<Out>(y.high)};
            store_two<some>(its_out, y, mask);
        }
    }
};

// 32 rows of the left operand (fewer at the end) · weights laid out. What follows one panel is done while the next is multiplied.
template <class T, class Following>
static inline void block_by_weights(const Left& left, const uint16_t* weights, Index steps, Index outputs, Index r, Index height,
                                    const Following& behind) {
    alignas(64) float sums[PANEL * PANEL];
    const Index panels = (outputs + PANEL - 1) / PANEL, products = steps * PRODUCTS<PARTS<T>>;
    const Index least_share = (height + products - 1) / products, share = PARTS<T> == 1 && least_share < 3 ? 3 : least_share;
    for (Index p = 0; p < panels; p++) {
        zero_sums();
        add_steps<PARTS<T>, LEFT_STAYS>(height > TILE, outputs - p * PANEL > TILE, left, weights + p * steps * 2 * PARTS<T> * NUMBERS,
                                        steps, false, [&](Index i) {
            if (p > 0 && i * share < height) behind(sums, r, (p - 1) * PANEL, i * share, least((i + 1) * share, height), PANEL);
        });
        store_sums(sums);
    }
    behind(sums, r, (panels - 1) * PANEL, 0, height, outputs - (panels - 1) * PANEL);
}

#endif
