// Convolutions on tiles: products with the windows of images, which are laid out in the cache and nowhere else.
//
// Images are (number, height, width, channels), as torch's channels last. A window's numbers stand in `kernel` pieces, one a line.

#include "behind.h"
#include "transposed.h"

#ifdef HAS_TILES

static inline Index most(Index a, Index b) { return a > b ? a : b; }

// `count` numbers, `apart` from one to the next, in another format one after the other.
template <class T>
static inline void convert(const float* x, Index apart, Index count, T* out) {
    const __m512i places = _mm512_mullo_epi32(_mm512_set_epi32(15, 14, 13, 12, 11, 10, 9, 8, 7, 6, 5, 4, 3, 2, 1, 0), _mm512_set1_epi32(apart));
    for (; count >= LANES; count -= LANES, x += LANES * apart, out += LANES)
        store(out, (Floats)_mm512_i32gather_ps(places, x, sizeof(float)));
    if (count > 0)
        store(out, (Floats)_mm512_mask_i32gather_ps(_mm512_setzero_ps(), first(count), places, x, sizeof(float)), count);
}

// What follows `count` numbers at `out` up to a step is overwritten with zeros.
static inline void copy(const BF16* x, Index count, BF16* out) {
    for (; count >= DEPTH; count -= DEPTH, x += DEPTH, out += DEPTH) _mm512_storeu_si512(out, _mm512_loadu_si512(x));
    if (count > 0) _mm512_storeu_si512(out, _mm512_maskz_loadu_epi16(first(count), x));
}
static inline void copy(const float* x, Index count, float* out) {
    for (; count >= LANES; count -= LANES, x += LANES, out += LANES) _mm512_storeu_ps(out, _mm512_loadu_ps(x));
    if (count > 0) _mm512_storeu_ps(out, _mm512_maskz_loadu_ps(first(count), x));
}

static inline void copy_exactly(const BF16* x, Index count, BF16* out) {
    for (; count >= DEPTH; count -= DEPTH, x += DEPTH, out += DEPTH) _mm512_storeu_si512(out, _mm512_loadu_si512(x));
    if (count > 0) _mm512_mask_storeu_epi16(out, first(count), _mm512_maskz_loadu_epi16(first(count), x));
}
static inline void copy_exactly(const float* x, Index count, float* out) {
    for (; count >= LANES; count -= LANES, x += LANES, out += LANES) _mm512_storeu_ps(out, _mm512_loadu_ps(x));
    if (count > 0) _mm512_mask_storeu_ps(out, first(count), _mm512_maskz_loadu_ps(first(count), x));
}

// One window for each pixel of a grid, from `stride` pixels apart; outside of the image there are zeros.
template <class T>
struct Windows {
    const T* image;
    Index height, width, channels;
    Index kernel_height, kernel_width, stride, grid_height, grid_width, top, left;  // top, left: lines and pixels above the image

    Index depth() const { return kernel_height * kernel_width * channels; }

    bool inside(Index x, Index y) const {
        return x >= 0 && x + kernel_width <= width && y >= 0 && y + kernel_height <= height;
    }

    // Numbers from `begin` to `end` of the windows from r on, to lines `apart` numbers apart. May overwrite a step behind them
    // with zeros.
    void read(Index r, Index count, Index begin, Index end, T* out, Index apart) const {
        Index x = r % grid_width, y = r / grid_width % grid_height, i = r / grid_width / grid_height;
        const Index run = kernel_width * channels, row = begin / run, at = begin - row * run;
        for (; count > 0; count--, out += apart) {
            const Index left_of = x * stride - left, line = y * stride - top;
            if (inside(left_of, line))
                read_inside(image + ((i * height + line + row) * width + left_of) * channels + at, run, at, end - begin, out);
            else
                read_border(i, line + row, left_of, run, at, end - begin, out);
            if (++x == grid_width) {
                x = 0;
                if (++y == grid_height) y = 0, i++;
            }
        }
    }

    void read_inside(const T* from, Index run, Index at, Index count, T* out) const {
        for (Index length = least(run - at, count); count > 0; length = least(run, count)) {
            copy(from, length, out);
            from += width * channels - at;
            at = 0;
            out += length, count -= length;
        }
    }

    void read_border(Index i, Index y, Index x, Index run, Index at, Index count, T* out) const {
        for (; count > 0; y++, at = 0) {
            const Index length = least(run - at, count);
            if (y < 0 || y >= height) {
                std::memset((void*)out, 0, length * sizeof(T));
            } else {
                const T* from = image + ((i * height + y) * width + x) * channels + at;
                const Index before = least(most(-x * channels - at, 0), length);
                const Index inside = least(most((width - x) * channels - at, before), length);
                if (before) std::memset((void*)out, 0, before * sizeof(T));
                copy(from + before, inside - before, out + before);
                if (inside < length) std::memset((void*)(out + inside), 0, (length - inside) * sizeof(T));
            }
            out += length, count -= length;
        }
    }

    // As the right operand of a transposed product, of images without a border.
    void find(Index r, Index count, const T** rows) const {
        Index x = r % grid_width, y = r / grid_width % grid_height, i = r / grid_width / grid_height;
        for (Index k = 0; k < count; k++) {
            rows[k] = image + ((i * height + y * stride) * width + x * stride) * channels;
            if (++x == grid_width) {
                x = 0;
                if (++y == grid_height) y = 0, i++;
            }
        }
    }
    void lay_out(const T** rows, Index count, Index c, Index columns, uint16_t* out) const {
        const Index run = kernel_width * channels, line = width * channels, row_of = c / run, at = c - row_of * run;
        if (at + least(columns, PANEL) <= run) {
            const Index start = row_of * line + at;
            const __mmask32 mask = first(columns);
            lay_tiles<RIGHT, T>([=](Index j, __m512i* parts) { row(rows[j] + start, mask, parts); }, count, out);
        } else if (at + least(columns, PANEL) <= 4 * run) {
            lay_out_pieces<4>(rows, count, c, least(columns, PANEL), out);
        } else {
            lay_out_pieces<PANEL>(rows, count, c, least(columns, PANEL), out);
        }
    }
    template <int most_pieces>
    void lay_out_pieces(const T** rows, Index count, Index c, Index columns, uint16_t* out) const {
        const Index run = kernel_width * channels, line = width * channels;
        Index starts[most_pieces] = {};
        __mmask32 masks[most_pieces] = {};
        int pieces = 0;
        for (Index at = 0; at < columns; pieces++) {
            const Index row_of = (c + at) / run, length = least((row_of + 1) * run - c - at, columns - at);
            starts[pieces] = row_of * line + c - row_of * run;
            masks[pieces] = first(at + length) & ~first(at);
            at += length;
        }
        if (most_pieces < PANEL) pieces = most_pieces;
        lay_tiles<RIGHT, T>([=](Index j, __m512i* parts) { row(rows[j], starts, masks, pieces, parts); }, count, out);
    }
};

// Results of a grid's pixels, (stride, stride, channels) each, as pixels of an image.
template <class T>
struct Pixels {
    T* image;
    Index height, width, channels, stride, grid_height, grid_width;

    void write(Index i, Index y, Index x, const T* result) const {
        const Index run = stride * channels, rows = least(height - y * stride, stride);
        const Index length = least(width - x * stride, stride) * channels;
        T* to = image + ((i * height + y * stride) * width + x * stride) * channels;
        for (Index row = 0; row < rows; row++) copy_exactly(result + row * run, length, to + row * width * channels);
    }
    void write_from(Index r, Index count, const T* results) const {
        Index x = r % grid_width, y = r / grid_width % grid_height, i = r / grid_width / grid_height;
        for (; count > 0; count--, results += stride * stride * channels) {
            write(i, y, x, results);
            if (++x == grid_width) {
                x = 0;
                if (++y == grid_height) y = 0, i++;
            }
        }
    }
};

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
    const Index panel = steps * 2 * PARTS<T> * NUMBERS, laid = PANEL * stride * PARTS<T>, panels = (outputs + PANEL - 1) / PANEL;
    const Index at_once = most(least(BLOCK / laid, 8), 1), size = at_once * PANEL, blocks = (rows + size - 1) / size;
#pragma omp parallel num_threads(least(threads, blocks))
    {
        static thread_local Scratch scratch;
        const Index laid_bytes = (at_once * laid + DEPTH) * sizeof(uint16_t), row_bytes = (PANEL * stride + DEPTH) * sizeof(T);
        char* memory = (char*)scratch.get(laid_bytes + row_bytes + size * outputs * sizeof(T));
        std::memset(memory, 0, laid_bytes + row_bytes);
        uint16_t* operand = (uint16_t*)memory;
        T* lines = (T*)(memory + laid_bytes);
        T* results = (T*)(memory + laid_bytes + row_bytes);
        alignas(64) float sums[2][4 * TILE * TILE] = {};
        Behind<T> its = behind;
        if (pixels) its.out = results;
        Tiles tiles;
#pragma omp for schedule(static)
        for (Index block = 0; block < blocks; block++) {
            const Index r = block * size, count = least(rows - r, size), here = pixels ? 0 : r, all = (count + PANEL - 1) / PANEL;
            const auto height = [&](Index b) { return least(count - b * PANEL, PANEL); };
            for (Index b = 0; b < all; b++)
                lay_out_windows(windows, r + b * PANEL, height(b), stride, lines, operand + b * laid);
            const auto write = [&](Index turn, Index begin, Index end) {
                const Index p = turn / all, b = turn % all;
                its(sums[turn % 2], here + b * PANEL, p * PANEL, begin, least(end, height(b)), least(outputs - p * PANEL, PANEL));
            };
            const Index share = (PANEL + steps - 1) / steps;
            for (Index turn = 0; turn < panels * all; turn++) {
                const Index p = turn / all, b = turn % all;
                const Left left = laid_out(operand + b * laid, stride, (T*)nullptr);
                const auto meanwhile = [&](Index i) {
                    if (turn > 0 && i * share < PANEL) write(turn - 1, i * share, (i + 1) * share);
                };
                zero_sums();
                add_steps<PARTS<T>>(height(b) > TILE, outputs - p * PANEL > TILE, left, weights + p * panel, steps, turn % 2, meanwhile);
                store_sums(sums[turn % 2]);
            }
            write(panels * all - 1, 0, PANEL);
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
    const Index laid = PANEL * stride * PARTS<T>, panels = (outputs + PANEL - 1) / PANEL, at_once = most(least(BLOCK / laid, 8), 1);
    const Index places = (images + PANEL - 1) / PANEL * windows.grid_height * windows.grid_width, blocks = (places + at_once - 1) / at_once;
#pragma omp parallel num_threads(least(threads, blocks))
    {
        static thread_local Scratch scratch;
        const Index laid_bytes = (at_once * laid + DEPTH) * sizeof(uint16_t), row_bytes = (PANEL * stride + DEPTH) * sizeof(T);
        char* memory = (char*)scratch.get(laid_bytes + row_bytes + at_once * PANEL * outputs * sizeof(T));
        uint16_t* operand = (uint16_t*)memory;
        T* lines = (T*)(memory + laid_bytes);
        T* results = (T*)(memory + laid_bytes + row_bytes);
        alignas(64) float sums[2][4 * TILE * TILE] = {};
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
                const Index p = turn / all, b = turn % all, count = here[b].steps, share = (PANEL + count) / most(count, 1);
                const Left left = laid_out(operand + b * laid, stride, (T*)nullptr);
                zero_sums();
                for (Index i = 0; i < count; i++) {
                    const Index s = turn % 2 ? count - 1 - i : i;
                    const uint16_t* right = weights + p * panel + here[b].which[s] * 2 * PARTS<T> * NUMBERS;
                    if (outputs - p * PANEL > TILE)
                        add_step<PARTS<T>>(left, s * left.step, right);
                    else
                        add_some_step<PARTS<T>, 2, 1>(left, s * left.step, right);
                    if (turn > 0 && i * share < PANEL) write(turn - 1, i * share, (i + 1) * share);
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

#endif
