// Imagined trajectories: the prior's steps one after the other, for 32 states at a time, and what the heads say of states. Only what
// heads read of a state leaves the nearest caches.

#include "chain.h"
#include "draws.h"
#include "gates.h"
#include "gather.h"

#ifdef HAS_TILES

// The RSSM's layers; weights of `input` lie in rows of whole cache lines, in one of two formats.
struct Dynamics {
    const void *rows, *action_rows, *bias;
    Index stride, hidden, actions, deter, variables, classes;
    ChainLayer gru;  // reads [hidden, deter]
    const float *norm_weight, *norm_bias;
    float epsilon;
    ChainLayer prior[2];
};

// n trajectories of `horizon` steps.
template <class T>
struct Trajectories {
    const float* start;    // deterministic state (n, deter)
    const T* addend;       // what the start's sample gives the first layer (n, hidden)
    const float* action;   // (n, horizon, actions)
    const float* uniform;  // in [0, 1), (horizon, n, variables)
    Index* classes;        // (horizon, n, variables), counted through all of them
    T* deter;              // (horizon, n, deter)
    Index n, horizon;
};

// What 32 trajectories are at now.
template <class T>
struct Now {
    Between<T> between;
    Index reads, stride, logits_stride;
    float* deter;            // (32, deter)
    T *inputs, *parts, *logits;  // (32, stride): [hidden, deter]; (32, 3 · deter); (32, variables · classes)
    Floats* room;

    explicit Now(const Dynamics& d)
        : between(widest_of(d.prior, 2) > d.gru.depth ? widest_of(d.prior, 2) : d.gru.depth), reads(d.gru.depth),
          stride(up_to(d.gru.depth, PANEL)), logits_stride(up_to(d.variables * d.classes, LANES)) {
        static thread_local Scratch scratch;
        const Index lines = 2 * ((d.classes + LANES - 1) / LANES);
        const Index numbers = PANEL * (stride + up_to(3 * d.deter, PANEL) + logits_stride);
        char* p = (char*)scratch.get(lines * sizeof(Floats) + PANEL * up_to(d.deter, LANES) * sizeof(float) + numbers * sizeof(T));
        room = (Floats*)p;
        deter = (float*)(room + lines);
        inputs = (T*)(deter + PANEL * up_to(d.deter, LANES));
        parts = inputs + PANEL * stride;
        logits = parts + PANEL * up_to(3 * d.deter, PANEL);
        // What stands behind a row meets weights of 0, but must be a number.
        std::memset(inputs, 0, PANEL * stride * sizeof(T));
    }
};

static inline void shorten(const float* x, float* out, Index size) { std::memcpy(out, x, size * sizeof(float)); }
static inline void shorten(const float* x, BF16* out, Index size) {
    for (Index i = 0; i < size; i += LANES) store_up_to(out + i, load_up_to(x + i, size - i), size - i);
}

template <class W, class T>
static void begin(const Dynamics& d, const Trajectories<T>& all, const Now<T>& now, Index r, Index height) {
    std::memcpy(now.deter, all.start + r * d.deter, height * d.deter * sizeof(float));
    for (Index i = 0; i < height; i++) shorten(now.deter + i * d.deter, now.inputs + i * now.stride + d.hidden, d.deter);
}

// One step of the trajectories from r on.
template <class W, class T>
static void step(const Dynamics& d, const Trajectories<T>& all, const Now<T>& now, Index h, Index r, Index height) {
    const SparseLayer<W> input = {(const W*)d.rows, (const W*)d.action_rows, (const W*)d.bias, h ? d.variables : 0,
                                  d.actions, d.stride, d.hidden, true};
    Index* const drawn = all.classes + (h * all.n + r) * d.variables;
    const Index* const before = h ? drawn - all.n * d.variables : nullptr;
    for (Index i = 0; i < height; i++) {
        sum_row(input, before + i * d.variables, all.action + ((r + i) * all.horizon + h) * d.actions,
                h ? nullptr : all.addend + (r + i) * d.hidden, now.inputs + i * now.stride);
    }
    const Left left = left_of(now.inputs, now.stride, height, now.reads, now.between.laid);
    const Behind<T> behind{d.gru.bias, nullptr, 0, false, now.parts, 3 * d.deter};
    block_by_weights<T>(left, d.gru.weights, steps_of(d.gru.depth), d.gru.outputs, 0, height, behind);
    for (Index i = 0; i < height; i++) {
        float* const deter = now.deter + i * d.deter;
        T* const shorter = now.inputs + i * now.stride + d.hidden;
        gates_of_row(now.parts + i * 3 * d.deter, d.norm_weight, d.norm_bias, d.epsilon, deter, deter, shorter, d.deter);
        std::memcpy(all.deter + ((h * all.n) + r + i) * d.deter, shorter, d.deter * sizeof(T));
    }
    now.between.chain(now.inputs + d.hidden, now.stride, height, (const T*)nullptr, 0, d.prior, 2, now.logits, now.logits_stride);
    const int vectors = usual_vectors(d.classes);
    auto draw = vectors == 2 ? draw_row<2, T> : vectors == 1 ? draw_row<1, T> : vectors == 4 ? draw_row<4, T> : draw_row<0, T>;
    for (Index i = 0; i < height; i++) {
        draw(now.logits + i * now.logits_stride, nullptr, all.uniform + (h * all.n + r + i) * d.variables, drawn + i * d.variables,
             nullptr, d.variables, d.classes, d.classes, now.room);
    }
}

// `W`: the format of `input`'s weights.
template <class W, class T>
static void rollout(const Dynamics& dynamics, const Trajectories<T>& all, int threads) {
    by_blocks(all.n, threads, [&] { return Now<T>(dynamics); }, [&](const Now<T>& now, Index r, Index height) {
        begin<W>(dynamics, all, now, r, height);
        for (Index h = 0; h < all.horizon; h++) step<W>(dynamics, all, now, h, r, height);
    });
}

// An MLP that reads states (n): their classes (n, variables) and the rest of the first layer's input, x (n, depth of layers[0]).
template <class W, class T>
static void head(const SparseLayer<W>& first, const Index* classes, const T* x, Index stride, Index n, const ChainLayer* layers,
                 Index count, float* out, int threads) {
    const Index widest = widest_of(layers, count), outputs = layers[count - 1].outputs;
    struct Room {
        Between<T> between;
        T* sums;
    };
    auto make = [&] {
        static thread_local Scratch scratch;
        return Room{Between<T>(widest), (T*)scratch.get(PANEL * first.width * sizeof(T))};
    };
    by_blocks(n, threads, make, [&](const Room& room, Index r, Index height) {
        for (Index i = 0; i < height; i++) {
            sum_row(first, classes + (r + i) * first.variables, (const float*)nullptr, (const T*)nullptr, room.sums + i * first.width);
        }
        room.between.chain(x + r * stride, stride, height, room.sums, first.width, layers, count, out + r * outputs, outputs);
    });
}

#define FOR(W, T, NAME)                                                                                                         \
    EXPORT void rollout_##NAME(const Dynamics* dynamics, const float* start, const T* addend, const float* action,              \
                               const float* uniform, Index* classes, T* deter, Index n, Index horizon, int threads) {           \
        rollout<W, T>(*dynamics, {start, addend, action, uniform, classes, deter, n, horizon}, threads);                        \
    }                                                                                                                           \
    EXPORT void head_##NAME(const W* rows, const W* bias, const Index* classes, Index variables, Index row_stride, const T* x,  \
                            Index stride, Index n, const ChainLayer* layers, Index count, Index width, float* out, int threads) { \
        head<W, T>({rows, nullptr, bias, variables, 0, row_stride, width, false}, classes, x, stride, n, layers, count, out,    \
                   threads);                                                                                                    \
    }
FOR(float, float, float)
FOR(BF16, BF16, bfloat16)
#ifdef __AVX512FP16__
FOR(Half, BF16, half)
#endif

#endif
