// Convolutions on tiles: products with the windows of images, which are laid out in the cache and nowhere else.

#include "behind.h"
#include "transposed.h"
#include "windows.h"

#ifdef HAS_TILES

constexpr Index MOST_STEPS = 512;    // of a window
constexpr Index BLOCK = 384 * 1024;  // numbers of windows laid out at a time: half of a core's cache

// Windows as the left operand, bfloat16 row after row, float32 as parts on tiles.
static inline void lay_out_windows(const Windows<BF16>& windows, Index r, Index count, Index stride, BF16*, uint16_t* out) {
    windows.read(r, count, 0, windows.depth(), (BF16*)out, stride);
}
static inline void lay_out_windows(const Windows<float>& windows, Index r, Index count, Index stride, float* rows, uint16_t* out) {
    windows.read(r, count, 0, windows.depth(), rows, stride);
    lay_out_left(rows, stride, count, windows.depth(), out);
}
static inline Left laid_out(const uint16_t* windows, Index stride, BF16*) { return Left((const BF16*)windows, stride); }
static inline Left laid_out(const uint16_t* windows, Index, float*) { return Left(windows, PARTS<float>); }

// windows · weights, one row for each pixel of the grid. To `pixels` if there are some, else to where `behind` says.
template <class T>
static void windows_by_weights(const Windows<T>& windows, Index rows, const uint16_t* weights, Index outputs, Behind<T> behind,
                               const Pixels<T>* pixels, int threads) {
    const Index steps = steps_of(windows.depth()), stride = (steps | 1) * DEPTH;  // an odd number of lines: spread over the cache
    const Index laid = PANEL * stride * PARTS<T>, at_once = most(least(BLOCK / laid, 8), 1);
    const Index size = at_once * PANEL, blocks = (rows + size - 1) / size;
#pragma omp parallel num_threads(least(threads, blocks))
    {
        static thread_local Scratch scratch;
        const Index laid_bytes = (at_once * laid + DEPTH) * sizeof(uint16_t), row_bytes = (PANEL * stride + DEPTH) * sizeof(T);
        char* memory = (char*)scratch.get(laid_bytes + row_bytes + size * outputs * sizeof(T));
        std::memset(memory, 0, laid_bytes + row_bytes);
        uint16_t* operand = (uint16_t*)memory;
        T* lines = (T*)(memory + laid_bytes);
        T* results = (T*)(memory + laid_bytes + row_bytes);
        Behind<T> its = behind;
        if (pixels) its.out = results;
        Tiles tiles;
#pragma omp for schedule(static)
        for (Index block = 0; block < blocks; block++) {
            const Index r = block * size, count = least(rows - r, size), here = pixels ? 0 : r, all = panels_of(count);
            const auto height = [&](Index b) { return least(count - b * PANEL, PANEL); };
            for (Index b = 0; b < all; b++)
                lay_out_windows(windows, r + b * PANEL, height(b), stride, lines, operand + b * laid);
            const auto left = [&](Index b) { return laid_out(operand + b * laid, stride, (T*)nullptr); };
            blocks_by_weights<T, RIGHT_STAYS>(left, count, weights, steps, outputs, here, its, [] {});
            if (pixels) pixels->write_from(r, count, results);
        }
    }
}

// The same to pixels, where a window's lines are whole steps. The rows of a panel are 32 images' windows at one place: what is
// outside of one is outside of all, and is left out.
template <class T>
struct Place {
    Index image, y, x, steps;
    const Windows<T>* windows;
    Index which[MOST_STEPS];  // of the weights' steps

    void start(const Windows<T>& its, Index at) {
        windows = &its;
        x = at % its.grid_width, y = at / its.grid_width % its.grid_height, image = at / its.grid_width / its.grid_height * PANEL;
        const Index pixel = its.channels / DEPTH;
        steps = 0;
        for (Index row = first_row(); row < last_row(); row++)
            for (Index s = (row * its.kernel_width + first_column()) * pixel; s < (row * its.kernel_width + last_column()) * pixel; s++)
                which[steps++] = s;
    }
    Index first_row() const { return most(windows->top - y, 0); }
    Index last_row() const { return least(windows->height + windows->top - y, windows->kernel_height); }
    Index first_column() const { return most(windows->left - x, 0); }
    Index last_column() const { return least(windows->width + windows->left - x, windows->kernel_width); }

    void read(Index count, T* out, Index apart) const {
        const Index run = most(last_column() - first_column(), 0) * windows->channels;
        for (Index j = 0; j < count; j++, out += apart) {
            T* to = out;
            for (Index row = first_row(); row < last_row(); row++, to += run) {
                const Index line = (image + j) * windows->height + y + row - windows->top;
                copy(windows->image + (line * windows->width + x + first_column() - windows->left) * windows->channels, run, to);
            }
        }
    }
};

static inline void lay_out_place(const Place<BF16>& place, Index count, Index stride, BF16*, uint16_t* out) {
    place.read(count, (BF16*)out, stride);
}
static inline void lay_out_place(const Place<float>& place, Index count, Index stride, float* rows, uint16_t* out) {
    place.read(count, rows, stride);
    lay_out_left(rows, stride, count, place.steps * DEPTH, out);
}

template <class T>
static void places_by_weights(const Windows<T>& windows, Index images, const uint16_t* weights, Index outputs, Behind<T> behind,
                              const Pixels<T>& pixels, int threads) {
    const Index steps = steps_of(windows.depth()), stride = (steps | 1) * DEPTH, panel = steps * 2 * PARTS<T> * NUMBERS;
    const Index laid = PANEL * stride * PARTS<T>, panels = panels_of(outputs), at_once = most(least(BLOCK / laid, 8), 1);
    const Index places = panels_of(images) * windows.grid_height * windows.grid_width, blocks = (places + at_once - 1) / at_once;
#pragma omp parallel num_threads(least(threads, blocks))
    {
        static thread_local Scratch scratch;
        const Index laid_bytes = (at_once * laid + DEPTH) * sizeof(uint16_t), row_bytes = (PANEL * stride + DEPTH) * sizeof(T);
        char* memory = (char*)scratch.get(laid_bytes + row_bytes + at_once * PANEL * outputs * sizeof(T));
        uint16_t* operand = (uint16_t*)memory;
        T* lines = (T*)(memory + laid_bytes);
        T* results = (T*)(memory + laid_bytes + row_bytes);
        alignas(64) float sums[2][PANEL * PANEL] = {};
        Place<T> here[8];
        Behind<T> its = behind;
        its.out = results;
        Tiles tiles;
#pragma omp for schedule(static)
        for (Index block = 0; block < blocks; block++) {
            const Index all = least(places - block * at_once, at_once);
            for (Index b = 0; b < all; b++) {
                here[b].start(windows, block * at_once + b);
                lay_out_place(here[b], least(images - here[b].image, PANEL), stride, lines, operand + b * laid);
            }
            const auto write = [&](Index turn, Index begin, Index end) {
                const Index p = turn / all, b = turn % all;
                its(sums[turn % 2], b * PANEL, p * PANEL, begin, least(end, PANEL), least(outputs - p * PANEL, PANEL));
            };
            for (Index turn = 0; turn < panels * all; turn++) {
                const Index p = turn / all, b = turn % all, count = here[b].steps;
                const Index products = most(count * PRODUCTS<PARTS<T>>, 1), share = (PANEL + products - 1) / products;
                const Left left = laid_out(operand + b * laid, stride, (T*)nullptr);
                Index done = 0;
                const auto meanwhile = [&] {
                    if (turn > 0 && done < PANEL) write(turn - 1, done, done + share);
                    done += share;
                };
                zero_sums();
                for (Index i = 0; i < count; i++) {
                    const Index s = turn % 2 ? count - 1 - i : i;
                    const uint16_t* right = weights + p * panel + here[b].which[s] * 2 * PARTS<T> * NUMBERS;
                    if (outputs - p * PANEL > TILE)
                        add_step<PARTS<T>, RIGHT_STAYS>(left, s * left.step, right, meanwhile);
                    else
                        add_some_step<PARTS<T>, RIGHT_STAYS, 2, 1>(left, s * left.step, right, meanwhile);
                }
                if (turn > 0 && count == 0) write(turn - 1, 0, PANEL);
                store_sums(sums[turn % 2]);
            }
            write(panels * all - 1, 0, PANEL);
            for (Index b = 0; b < all; b++)
                for (Index j = 0; j < least(images - here[b].image, PANEL); j++)
                    pixels.write(here[b].image + j, here[b].y, here[b].x, results + (b * PANEL + j) * outputs);
        }
    }
}

// The same, a line of the grid in panels of 32 windows each, for windows of few channels: the image's lines are copied, with their
// borders, and tiles read the windows from them, overlapping as they do. A window's pieces take whole steps each, and what stands
// behind them on the line meets weights of 0.
static void lines_by_weights(const Windows<BF16>& windows, Index images, const uint16_t* weights, Index outputs, Behind<BF16> behind,
                             const Pixels<BF16>* pixels, int threads) {
    const Index channels = windows.channels, piece = steps_of(windows.kernel_width * channels), steps = windows.kernel_height * piece;
    const Index apart = windows.stride * channels, line = (steps_of((PANEL - 1) * apart) + piece) * DEPTH;
    const Index laid = windows.kernel_height * line, panel = steps * 2 * NUMBERS, panels = panels_of(outputs);
    const Index width = windows.grid_width, across = panels_of(width), all_panels = images * windows.grid_height * across;
    const Index at_once = most(least(BLOCK / laid, 8), 1), blocks = (all_panels + at_once - 1) / at_once;
#pragma omp parallel num_threads(least(threads, blocks))
    {
        static thread_local Scratch scratch;
        const Index laid_bytes = (at_once * laid + DEPTH) * sizeof(BF16);
        char* memory = (char*)scratch.get(laid_bytes + at_once * PANEL * outputs * sizeof(BF16));
        std::memset(memory, 0, laid_bytes);
        BF16 *lines = (BF16*)memory, *results = (BF16*)(memory + laid_bytes);
        alignas(64) float sums[2][PANEL * PANEL] = {};
        Behind<BF16> its = behind;
        if (pixels) its.out = results;
        Tiles tiles;
#pragma omp for schedule(static)
        for (Index block = 0; block < blocks; block++) {
            const Index begin = block * at_once, all = least(all_panels - begin, at_once);
            Index rows[8], heights[8];  // of the result
            for (Index b = 0; b < all; b++) {
                const Index x = (begin + b) % across * PANEL, y = (begin + b) / across;
                rows[b] = y * width + x, heights[b] = least(width - x, PANEL);
                const Index count = ((heights[b] - 1) * windows.stride + windows.kernel_width) * channels;
                const Index from = x * windows.stride - windows.left, top = y % windows.grid_height * windows.stride - windows.top;
                for (Index row = 0; row < windows.kernel_height; row++)
                    windows.read_border(y / windows.grid_height, top + row, from, count, 0, count, lines + b * laid + row * line);
            }
            const auto write = [&](Index turn, Index first_row, Index end) {
                const Index p = turn / all, b = turn % all, row = pixels ? b * PANEL : rows[b];
                its(sums[turn % 2], row, p * PANEL, first_row, least(end, heights[b]), least(outputs - p * PANEL, PANEL));
            };
            const Index share = (PANEL + steps - 1) / steps;
            for (Index turn = 0; turn < panels * all; turn++) {
                const Index p = turn / all, b = turn % all;
                const Left left((const BF16*)lines + b * laid, apart);
                const uint16_t* right = weights + p * panel;
                Index done = 0;
                const auto meanwhile = [&] {
                    if (turn > 0 && done < PANEL) write(turn - 1, done, done + share);
                    done += share;
                };
                zero_sums();
                for (Index row = 0; row < windows.kernel_height; row++) {
                    for (Index i = 0; i < piece; i++, right += 2 * NUMBERS) {
                        if (outputs - p * PANEL > TILE)
                            add_step<1, RIGHT_STAYS>(left, row * line + i * DEPTH, right, meanwhile);
                        else
                            add_some_step<1, RIGHT_STAYS, 2, 1>(left, row * line + i * DEPTH, right, meanwhile);
                    }
                }
                store_sums(sums[turn % 2]);
            }
            write(panels * all - 1, 0, PANEL);
            for (Index b = 0; pixels && b < all; b++) pixels->write_from(rows[b], heights[b], results + b * PANEL * outputs);
        }
    }
}

// -- weights ------------------------------------------------------------------------------------------------------------

// Weights (narrow, wide, height, width) as rows (narrow) of windows (height, width, wide).
template <class T>
static void weights_of_windows(const float* weight, Index narrow, Index wide, Index height, Index width, T* out, int threads) {
    const Index places = height * width;
#pragma omp parallel for num_threads(threads) if (narrow * wide * places > WORTH_A_THREAD)
    for (Index n = 0; n < narrow; n++)
        for (Index p = 0; p < places; p++)
            convert(weight + n * wide * places + p, places, wide, out + (n * places + p) * wide);
}

// The same as what the narrow pixels (few high, few wide, narrow) do to stride² wide ones (stride, stride, wide): the last narrow
// pixel meets the kernel's first numbers. Where the stride does not divide the kernel there are zeros.
template <class T>
static void weights_of_phases(const float* weight, Index narrow, Index wide, Index height, Index width, Index stride, T* out,
                              int threads) {
    const Index places = height * width, few_high = (height + stride - 1) / stride, few_wide = (width + stride - 1) / stride;
#pragma omp parallel for num_threads(threads) if (narrow * wide * places > WORTH_A_THREAD)
    for (Index n = 0; n < narrow; n++) {
        for (Index few = 0; few < few_high * few_wide; few++) {
            T* to = out + (few * narrow + n) * stride * stride * wide;
            const Index top = (few_high - 1 - few / few_wide) * stride, left = (few_wide - 1 - few % few_wide) * stride;
            for (Index pixel = 0; pixel < stride * stride; pixel++, to += wide) {
                const Index y = top + pixel / stride, x = left + pixel % stride;
                if (y < height && x < width)
                    convert(weight + n * wide * places + y * width + x, places, wide, to);
                else
                    std::memset((void*)to, 0, wide * sizeof(T));
            }
        }
    }
}

// shape: number, height, width and channels of images, height and width of kernels, stride, height and width of the grid, lines
// above and pixels left of an image, and the stride of pixels to write to, 0 if there are none.
template <class T>
static Windows<T> windows_of(const Index* shape, const T* image) {
    return {image, shape[1], shape[2], shape[3], shape[4], shape[5], shape[6], shape[7], shape[8], shape[9], shape[10]};
}

#define FOR(T, NAME)                                                                                                   \
    EXPORT void windows_by_weights_##NAME(const Index* shape, const T* image, const uint16_t* weights, Index outputs,  \
                                          const float* bias, int elu, T* out, Index out_height, Index out_width, int threads) { \
        const Windows<T> windows = windows_of(shape, image);                                                           \
        const Index grid = windows.grid_height * windows.grid_width;                                                   \
        const Behind<T> behind{bias, nullptr, 0, (bool)elu, out, outputs};                                             \
        const Index step = shape[11];                                                                                  \
        const Pixels<T> pixels{out, out_height, out_width, outputs / most(step * step, 1), step, windows.grid_height, windows.grid_width}; \
        if (step && windows.stride == 1 && windows.top + windows.left > 0 && windows.channels % DEPTH == 0 &&         \
            windows.depth() <= MOST_STEPS * DEPTH)                                                                     \
            places_by_weights(windows, shape[0], weights, outputs, behind, pixels, threads);                           \
        else                                                                                                           \
            windows_by_weights(windows, shape[0] * grid, weights, outputs, behind, step ? &pixels : nullptr, threads); \
    }                                                                                                                  \
    EXPORT void arrange_weights_##NAME(const float* weight, Index narrow, Index wide, Index height, Index width, Index stride, T* out, \
                                       int threads) {                                                                  \
        if (stride)                                                                                                    \
            weights_of_phases(weight, narrow, wide, height, width, stride, out, threads);                              \
        else                                                                                                           \
            weights_of_windows(weight, narrow, wide, height, width, out, threads);                                     \
    }                                                                                                                  \
    EXPORT void transposed_by_windows_##NAME(const Index* shape, const T* image, const T* left, Index m, float* sums, float* out, \
                                             int threads) {                                                            \
        const Windows<T> windows = windows_of(shape, image);                                                           \
        const Index rows = shape[0] * windows.grid_height * windows.grid_width;                                        \
        transposed_product(left, m, windows, sums, out, rows, m, windows.depth(), shape[4] * shape[5], threads);       \
    }

FOR(float, float)
FOR(BF16, bfloat16)

EXPORT void lines_by_weights(const Index* shape, const BF16* image, const uint16_t* weights, Index outputs, const float* bias, int elu,
                             BF16* out, Index out_height, Index out_width, int threads) {
    const Windows<BF16> windows = windows_of(shape, image);
    const Behind<BF16> behind{bias, nullptr, 0, (bool)elu, out, outputs};
    const Index step = shape[11];
    const Pixels<BF16> pixels{out, out_height, out_width, outputs / most(step * step, 1), step, windows.grid_height, windows.grid_width};
    lines_by_weights(windows, shape[0], weights, outputs, behind, step ? &pixels : nullptr, threads);
}

#endif
