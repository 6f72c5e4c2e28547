// Windows of images and where their results go. Images are (number, height, width, channels), as torch's channels last; a window's
// numbers stand in pieces, one a line.
#pragma once

#include "tiles.h"

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
    Columns columns(Index c, Index count) const {
        Columns its;
        const Index run = kernel_width * channels, line = width * channels;
        for (Index at = 0, end; at < count; at = end) {
            const Index row_of = (c + at) / run;
            end = least((row_of + 1) * run - c, count);
            its.add(row_of * line + c - row_of * run, at, end);
        }
        return its;
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

#endif
