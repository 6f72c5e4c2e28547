// A layer whose input is mostly ones at known places: rows of its weights are added up, and a few columns times numbers.
//
// Weights lie in rows of whole cache lines (`stride` numbers apart). The sums of a state stay in registers, in float32.

#include "lanes.h"

#include <utility>

// A cache line of numbers in float32.
template <class T>
struct Line;

template <>
struct Line<float> {
    static constexpr Index SIZE = LANES;
    Floats x;
    static Line from(const float* p) { return {load(p)}; }
    void add(const Line& other) { x += other.x; }
    void add(float factor, const Line& other) { x += factor * other.x; }
    void apply_elu() { x = elu(x); }
    void put(float* p) const { store(p, x); }
};

// Sixteen numbers at even places and sixteen at odd ones.
template <>
struct Line<BF16> {
    static constexpr Index SIZE = 2 * LANES;
    Floats even, odd;
    static Line from(const BF16* p) {
        const Bits both = read<Bits>(p);
        return {(Floats)(both << 16), (Floats)(both & 0xffff0000)};
    }
    void add(const Line& other) { even += other.even, odd += other.odd; }
    void add(float factor, const Line& other) { even += factor * other.even, odd += factor * other.odd; }
    void apply_elu() { even = elu(even), odd = elu(odd); }
    void put(BF16* p) const {
        BF16 low[LANES], high[LANES];
        store(low, even), store(high, odd);
        const Bits both = __builtin_convertvector(read<Shorts>(low), Bits) | __builtin_convertvector(read<Shorts>(high), Bits) << 16;
        std::memcpy(p, &both, sizeof both);
    }
};

template <class T>
struct Layer {
    const T *rows, *others, *bias;  // of the ones, of the other numbers, null for none
    Index variables, count, stride, width;
    bool with_elu;
};

// Some lines of one state.
template <class T, int LINES>
static void lines(const Layer<T>& layer, const Index* classes, const float* x, const T* addend, T* out, Index first) {
    using L = Line<T>;
    L sums[LINES];
#pragma GCC unroll 16
    for (int i = 0; i < LINES; i++) sums[i] = layer.bias ? L::from(layer.bias + first + i * L::SIZE) : L{};
    for (Index s = 0; s < layer.variables; s++) {
        const T* row = layer.rows + classes[s] * layer.stride + first;
#pragma GCC unroll 16
        for (int i = 0; i < LINES; i++) sums[i].add(L::from(row + i * L::SIZE));
    }
    for (Index s = 0; s < layer.count; s++) {
        const T* row = layer.others + s * layer.stride + first;
#pragma GCC unroll 16
        for (int i = 0; i < LINES; i++) sums[i].add(x[s], L::from(row + i * L::SIZE));
    }
    for (int i = 0; i < LINES; i++) {
        const Index begin = first + i * L::SIZE, left = layer.width - begin, bytes = (left < L::SIZE ? left : L::SIZE) * sizeof(T);
        if (addend) {
            T some[L::SIZE] = {};
            std::memcpy(some, addend + begin, bytes);
            sums[i].add(L::from(some));
        }
        if (layer.with_elu) sums[i].apply_elu();
        if (left >= L::SIZE) {
            sums[i].put(out + begin);
        } else {
            T some[L::SIZE];
            sums[i].put(some);
            std::memcpy(out + begin, some, bytes);
        }
    }
}

// As many lines at once as registers hold.
constexpr Index MOST = 13;
template <class T>
using Lines = void (*)(const Layer<T>&, const Index*, const float*, const T*, T*, Index);
template <class T, int... I>
static Lines<T> some_lines(Index count, std::integer_sequence<int, I...>) {
    static const Lines<T> all_counts[] = {lines<T, I + 1>...};
    return all_counts[count - 1];
}

template <class T>
static void gather(const Layer<T>& layer, const Index* classes, const float* x, Index x_stride, const T* addend, T* out, Index out_stride,
                   Index n, int threads) {
    const Index count = (layer.width + Line<T>::SIZE - 1) / Line<T>::SIZE, blocks = (count + MOST - 1) / MOST;
#pragma omp parallel for num_threads(threads) schedule(static) if (n * layer.width > WORTH_A_THREAD / 16)
    for (Index r = 0; r < n; r++) {
        for (Index b = 0; b < blocks; b++) {
            const Index begin = count * b / blocks, end = count * (b + 1) / blocks;
            some_lines<T>(end - begin, std::make_integer_sequence<int, MOST>())(
                layer, classes + r * layer.variables, x + r * x_stride, addend ? addend + r * layer.width : nullptr,
                out + r * out_stride, begin * Line<T>::SIZE);
        }
    }
}

// out (n, width), out_stride apart ← Σ rows[classes] + Σ x · others + bias + addend, then ELU if asked for; classes (n, variables), x
// (n, count), addend (n, width) or null, bias (stride) or null. rows, others and bias hold whole lines of 64 bytes.
#define FOR(T, NAME)                                                                                                           \
    EXPORT void gather_##NAME(const T* rows, const Index* classes, Index variables, const T* others, const float* x, Index count, \
                              Index x_stride, const T* bias, const T* addend, T* out, Index out_stride, Index n, Index width,  \
                              Index stride, int with_elu, int threads) {                                                       \
        gather(Layer<T>{rows, others, bias, variables, count, stride, width, with_elu != 0}, classes, x, x_stride, addend, out, \
               out_stride, n, threads);                                                                                        \
    }
FOR(float, float)
FOR(BF16, bfloat16)
