// A processor's tiles (AMX): matrices of 16 rows of 32 bfloat16 numbers. One instruction multiplies a tile of the left operand
// with one of the right and adds the product to a tile of 16×16 sums in float32. What operands look like: layout.h.
#pragma once

#include "layout.h"

#ifdef HAS_TILES

#include <cstdlib>

struct alignas(64) TileShapes {
    uint8_t palette = 1, start_row = 0, reserved[14] = {};
    uint16_t row_bytes[16] = {64, 64, 64, 64, 64, 64, 64, 64};
    uint8_t rows[16] = {16, 16, 16, 16, 16, 16, 16, 16};
};

// Tiles belong to everybody in a thread: whoever shaped them before finds them so.
class Tiles {
    alignas(64) uint8_t before[64];

  public:
    Tiles() {
        static const TileShapes shapes;
        _tile_storeconfig(before);
        _tile_loadconfig(&shapes);
    }
    ~Tiles() { _tile_loadconfig(before); }
};

// The left operand's 32 rows: where its two tiles are, and how far it is to the next row and to the next step.
struct Left {
    const uint16_t *upper, *lower;
    Index row_bytes, step;

    Left(const uint16_t* panel, int parts) : upper(panel), lower(panel + NUMBERS), row_bytes(64), step(2 * parts * NUMBERS) {}
    Left(const BF16* x, Index stride)
        : upper((const uint16_t*)x), lower((const uint16_t*)(x + TILE * stride)), row_bytes(2 * stride), step(DEPTH) {}
};

// The right operand stays in the nearest cache; or it passes it by, so that the left one stays.
enum Nearest { RIGHT_STAYS, LEFT_STAYS };

// A macro, because an instruction names its register.
#define LOAD_RIGHT(REGISTER, FROM)                                                                                     \
    if constexpr (nearest == LEFT_STAYS) {                                                                             \
        _tile_stream_loadd(REGISTER, FROM, 64);                                                                        \
    } else {                                                                                                           \
        _tile_loadd(REGISTER, FROM, 64);                                                                               \
    }

// Sums 0 and 1 (upper), 2 and 3 (lower) += one part of a step of the left · one of the right, tiles in registers 4 to 7; each is
// loaded, where it is not there yet, just before it is needed.
template <Nearest nearest, bool load_left, bool load_right>
static inline void multiply(const Left& a, Index at, const uint16_t* b) {
    if constexpr (load_right) { LOAD_RIGHT(6, b) }
    if constexpr (load_left) _tile_loadd(4, a.upper + at, a.row_bytes);
    _tile_dpbf16ps(0, 4, 6);
    if constexpr (load_left) _tile_loadd(5, a.lower + at, a.row_bytes);
    _tile_dpbf16ps(2, 5, 6);
    if constexpr (load_right) { LOAD_RIGHT(7, b + NUMBERS) }
    _tile_dpbf16ps(1, 4, 7);
    _tile_dpbf16ps(3, 5, 7);
}

// Products of parts that make one of numbers.
template <int parts>
constexpr Index PRODUCTS = parts * (parts + 1) / 2;

// The 32×32 sums in registers 0 to 3 += one step of the left · one of the right. After each product of parts goes on what else there
// is to do: tiles are multiplied beside it, as long as it is little at a time.
template <int parts, Nearest nearest, class Meanwhile>
static inline void add_step(const Left& a, Index at, const uint16_t* b, Meanwhile meanwhile) {
    constexpr Index PART = 2 * NUMBERS;
    if constexpr (parts == 1) {
        multiply<nearest, true, true>(a, at, b);
    } else {
        multiply<RIGHT_STAYS, true, true>(a, at, b);
        meanwhile();
        multiply<RIGHT_STAYS, false, true>(a, at, b + 2 * PART);
        meanwhile();
        multiply<RIGHT_STAYS, false, true>(a, at, b + PART);
        meanwhile();
        multiply<RIGHT_STAYS, true, false>(a, at + PART, b);
        meanwhile();
        multiply<RIGHT_STAYS, false, true>(a, at, b);
        meanwhile();
        multiply<RIGHT_STAYS, true, false>(a, at + 2 * PART, b);
    }
    meanwhile();
}

// The same where there are fewer rows (tall: 1 for 16) or columns (wide).
template <int parts, Nearest nearest, int tall, int wide, class Meanwhile>
static inline void add_some_step(const Left& a, Index at, const uint16_t* b, Meanwhile meanwhile) {
    for (int left = 0; left < parts; left++) {
        _tile_loadd(4, a.upper + at + 2 * left * NUMBERS, a.row_bytes);
        if (tall == 2) _tile_loadd(5, a.lower + at + 2 * left * NUMBERS, a.row_bytes);
        for (int i = 0; i < parts - left; i++) {
            const int right = left == 0 ? (parts - i) % parts : parts - left - 1 - i;  // the order of whole steps
            LOAD_RIGHT(6, b + 2 * right * NUMBERS)
            if (wide == 2) { LOAD_RIGHT(7, b + (2 * right + 1) * NUMBERS) }
            _tile_dpbf16ps(0, 4, 6);
            if (wide == 2) _tile_dpbf16ps(1, 4, 7);
            if (tall == 2) _tile_dpbf16ps(2, 5, 6);
            if (tall == 2 && wide == 2) _tile_dpbf16ps(3, 5, 7);
            meanwhile();
        }
    }
}

// All steps; meanwhile(i) counts products of parts.
template <int parts, Nearest nearest, int tall, int wide, class Meanwhile>
static inline void add_steps(const Left& a, const uint16_t* b, Index steps, bool backwards, Meanwhile meanwhile) {
    Index products = 0;
    const auto work = [&] { meanwhile(products++); };
    for (Index i = 0; i < steps; i++) {
        const Index s = backwards ? steps - 1 - i : i;
        if constexpr (tall == 2 && wide == 2)
            add_step<parts, nearest>(a, s * a.step, b + s * 2 * parts * NUMBERS, work);
        else
            add_some_step<parts, nearest, tall, wide>(a, s * a.step, b + s * 2 * parts * NUMBERS, work);
    }
}
template <int parts, Nearest nearest, class Meanwhile>
static inline void add_steps(bool tall, bool wide, const Left& a, const uint16_t* b, Index steps, bool backwards, Meanwhile meanwhile) {
    if (tall && wide)
        add_steps<parts, nearest, 2, 2>(a, b, steps, backwards, meanwhile);
    else if (tall)
        add_steps<parts, nearest, 2, 1>(a, b, steps, backwards, meanwhile);
    else if (wide)
        add_steps<parts, nearest, 1, 2>(a, b, steps, backwards, meanwhile);
    else
        add_steps<parts, nearest, 1, 1>(a, b, steps, backwards, meanwhile);
}

// Some bits of work, as even as can be, in so many calls.
struct Pace {
    Index bits, calls, credit = 0;

    template <class Work>
    void operator()(Work work) {
        for (credit += bits; credit >= calls; credit -= calls) work();
    }
};

// The 32×32 sums in memory, row by row.
static inline void load_sums(const float* c) {
    _tile_loadd(0, c, 4 * PANEL);
    _tile_loadd(1, c + TILE, 4 * PANEL);
    _tile_loadd(2, c + TILE * PANEL, 4 * PANEL);
    _tile_loadd(3, c + TILE * PANEL + TILE, 4 * PANEL);
}
static inline void store_sums(float* c) {
    _tile_stored(0, c, 4 * PANEL);
    _tile_stored(1, c + TILE, 4 * PANEL);
    _tile_stored(2, c + TILE * PANEL, 4 * PANEL);
    _tile_stored(3, c + TILE * PANEL + TILE, 4 * PANEL);
}
static inline void zero_sums() {
    _tile_zero(0);
    _tile_zero(1);
    _tile_zero(2);
    _tile_zero(3);
}

// Memory of a thread, kept.
struct Scratch {
    char* p = nullptr;
    size_t size = 0;
    void* get(size_t bytes) {
        if (bytes > size) {
            std::free(p);
            p = (char*)std::aligned_alloc(4096, size = up_to(bytes + bytes / 4, 4096));
        }
        return p;
    }
    ~Scratch() { std::free(p); }
};

#endif
