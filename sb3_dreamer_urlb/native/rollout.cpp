// Imagined trajectories: the prior's steps one after the other, for some states at a time. Only what heads read of a state leaves the
// nearer caches.

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


// Trajectories at a time: their numbers and the weights of the step's layers are what the second cache holds.
constexpr Index GROUP = 288;

// What they are at now.
template <class T>
struct Now {
    Between<T> between;
    Index stride;
    float* deter;                // (GROUP, deter)
    T *inputs, *parts, *logits;  // (GROUP, stride): [hidden, deter]; (GROUP, 3 · deter); (32, variables · classes)
    Floats* room;                // for draws

    explicit Now(const Dynamics& d)
        : between(widest_of(d.prior, 2) > d.gru.depth ? widest_of(d.prior, 2) : d.gru.depth), stride(up_to(d.gru.depth, PANEL)) {
        static thread_local Scratch scratch;
        const Index lines = 2 * ((d.classes + LANES - 1) / LANES), floats = up_to(GROUP * d.deter, LANES);
        const Index its_parts = up_to(GROUP * 3 * d.deter, PANEL);
        const Index numbers = GROUP * stride + its_parts + PANEL * d.variables * d.classes;
        room = (Floats*)scratch.get(lines * sizeof(Floats) + floats * sizeof(float) + numbers * sizeof(T));
        deter = (float*)(room + lines);
        inputs = (T*)(deter + floats);
        parts = inputs + GROUP * stride;
        logits = parts + its_parts;
        // What stands behind a row meets weights of 0, but must be a number.
        std::memset(inputs, 0, GROUP * stride * sizeof(T));
    }
};

static inline void shorten(const float* x, float* out, Index size) { std::memcpy(out, x, size * sizeof(float)); }
static inline void shorten(const float* x, BF16* out, Index size) {
    for (Index i = 0; i < size; i += LANES) store_up_to(out + i, load_up_to(x + i, size - i), size - i);
}

template <class T>
static void begin(const Dynamics& d, const Trajectories<T>& all, const Now<T>& now, Index r, Index count) {
    std::memcpy(now.deter, all.start + r * d.deter, count * d.deter * sizeof(float));
    for (Index i = 0; i < count; i++) shorten(now.deter + i * d.deter, now.inputs + i * now.stride + d.hidden, d.deter);
}

// The deterministic states at h + 1 of trajectories from r on: each layer for all of them, whose weights stay near meanwhile.
template <class W, class T>
static void recur(const Dynamics& d, const Trajectories<T>& all, const Now<T>& now, Index h, Index r, Index count) {
    const SparseLayer<W> input = {(const W*)d.rows, (const W*)d.action_rows, (const W*)d.bias, h ? d.variables : 0,
                                  d.actions, d.stride, d.hidden, true};
    const Index* before = all.classes + ((h ? h - 1 : 0) * all.n + r) * d.variables;
    for (Index i = 0; i < count; i++) {
        sum_row(input, before + i * d.variables, all.action + ((r + i) * all.horizon + h) * d.actions,
                h ? nullptr : all.addend + (r + i) * d.hidden, now.inputs + i * now.stride);
    }
    for (Index i = 0; i < count; i += PANEL) {
        const Index height = least(count - i, PANEL);
        const Left left = left_of(now.inputs + i * now.stride, now.stride, height, d.gru.depth, now.between.laid);
        const Behind<T> behind{d.gru.bias, nullptr, 0, false, now.parts + i * 3 * d.deter, 3 * d.deter};
        block_by_weights<T>(left, d.gru.weights, steps_of(d.gru.depth), d.gru.outputs, 0, height, behind);
    }
    for (Index i = 0; i < count; i++) {
        float* const deter = now.deter + i * d.deter;
        T* const shorter = now.inputs + i * now.stride + d.hidden;
        gates_of_row(now.parts + i * 3 * d.deter, d.norm_weight, d.norm_bias, d.epsilon, deter, deter, shorter, d.deter);
        std::memcpy(all.deter + (h * all.n + r + i) * d.deter, shorter, d.deter * sizeof(T));
    }
}

// Their classes.
template <class T>
static void draw_all(const Dynamics& d, const Trajectories<T>& all, const Now<T>& now, Index h, Index r, Index count) {
    const int vectors = usual_vectors(d.classes);
    auto draw = vectors == 2 ? draw_row<2, T> : vectors == 1 ? draw_row<1, T> : vectors == 4 ? draw_row<4, T> : draw_row<0, T>;
    const Index size = d.variables * d.classes;
    for (Index begin = 0; begin < count; begin += PANEL) {
        const Index height = least(count - begin, PANEL), first = (h * all.n + r + begin) * d.variables;
        now.between.chain(now.inputs + begin * now.stride + d.hidden, now.stride, height, (const T*)nullptr, 0, d.prior, 2, now.logits,
                          size);
        for (Index i = 0; i < height; i++) {
            draw(now.logits + i * size, nullptr, all.uniform + first + i * d.variables, all.classes + first + i * d.variables, nullptr,
                 d.variables, d.classes, d.classes, now.room);
        }
    }
}

// `W`: the format of `input`'s weights.
template <class W, class T>
static void rollout(const Dynamics& dynamics, const Trajectories<T>& all, int threads) {
    by_blocks(all.n, GROUP, threads, [&] { return Now<T>(dynamics); }, [&](const Now<T>& now, Index r, Index count) {
        begin(dynamics, all, now, r, count);
        for (Index h = 0; h < all.horizon; h++) {
            recur<W>(dynamics, all, now, h, r, count);
            draw_all(dynamics, all, now, h, r, count);
        }
    });
}

#define FOR(W, T, NAME)                                                                                                         \
    EXPORT void rollout_##NAME(const Dynamics* dynamics, const float* start, const T* addend, const float* action,              \
                               const float* uniform, Index* classes, T* deter, Index n, Index horizon, int threads) {           \
        rollout<W, T>(*dynamics, {start, addend, action, uniform, classes, deter, n, horizon}, threads);                        \
    }
FOR(float, float, float)
FOR(BF16, BF16, bfloat16)
#ifdef __AVX512FP16__
FOR(Half, BF16, half)
EXPORT int has_half_rollouts() { return 1; }
#endif

#endif
