"""The planner's kernels are torch's arithmetic within roundings, and plans with them are plans."""

from __future__ import annotations

import math

import pytest
import torch as th
import torch.nn.functional as F
from golden import deterministic_draws
from hypothesis import given, settings
from hypothesis import strategies as st
from planning_forms import METHODS, M, N, agent_and_skill, check_short_products, check_states_and_scores
from tiny import threads_of

from sb3_dreamer_urlb import native
from sb3_dreamer_urlb.agent import Agent, PlannedAgent
from sb3_dreamer_urlb.native import planner_ops
from sb3_dreamer_urlb.nn import distributions
from sb3_dreamer_urlb.planning import DynaMPC, PlannerConfig
from sb3_dreamer_urlb.planning.prepared.agent import NativeAgent, PreparedAgent, planned
from sb3_dreamer_urlb.planning.prepared.native_parts import NativeDynamics, NativeHead
from sb3_dreamer_urlb.types import LatentState
from sb3_dreamer_urlb.world_model.rssm import RSSM

FORMATS = [th.float32, th.bfloat16]
#: relative errors of one number
ROUNDING = {th.float32: 1e-6, th.bfloat16: 2**-8}
#: what a GRU's new state may be off where it is asked for in a format
GATES = {th.float32: 2e-5, th.bfloat16: 5e-4}


@pytest.fixture(scope="module", autouse=True)
def lanes(kernels):
    """On processors where torch's are faster these must be right all the same."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(planner_ops, "fast", lambda: True)
        yield


def _generator(seed: int = 0) -> th.Generator:
    return th.Generator().manual_seed(seed)


def _numbers(*shape: int, seed: int = 0, dtype: th.dtype = th.float32) -> th.Tensor:
    return th.randn(shape, generator=_generator(seed)).to(dtype)


# -- draws -----------------------------------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=60)
@given(
    n=st.integers(0, 40),
    variables=st.integers(1, 9),
    size=st.one_of(st.sampled_from([1, 2, 16, 32, 64]), st.integers(1, 150)),
    dtype=st.sampled_from(FORMATS),
    with_bias=st.booleans(),
    counted=st.booleans(),
)
def test_draws_invert_the_distribution(n, variables, size, dtype, with_bias, counted):
    logits = 3 * _numbers(n, variables, size, seed=size).to(dtype)
    bias = _numbers(variables, size, seed=1) if with_bias else None
    uniform = th.rand(n, variables, generator=_generator(n))
    classes, probs = planner_ops.draws(logits, bias, uniform, counted, True)
    exact = (logits.double() + (0 if bias is None else bias)).softmax(-1)
    assert probs.dtype == th.float32 and th.allclose(probs.double(), exact, rtol=2e-5, atol=1e-7)
    assert classes.dtype == th.int64 and classes.shape == (n, variables)
    if counted:
        classes = classes - th.arange(variables) * size
    assert ((classes >= 0) & (classes < size)).all()
    # The uniform number lies between the sums up to this class, without it and with it, but for a rounding.
    above = exact.cumsum(-1).gather(-1, classes.unsqueeze(-1)).squeeze(-1)
    below = above - exact.gather(-1, classes.unsqueeze(-1)).squeeze(-1)
    assert (below - 1e-6 <= uniform).all() and (uniform <= above + 1e-6).all()
    assert th.equal(
        planner_ops.draws(logits, bias, uniform, counted, False)[0] - (th.arange(variables) * size if counted else 0), classes
    )


def test_draws_do_not_depend_on_threads():
    logits, uniform = _numbers(600, 4, 32), th.rand(600, 4)
    drawn = []
    for count in (1, 2):
        with threads_of(count):
            drawn.append(planner_ops.draws(logits, None, uniform, True, True))
    assert all(th.equal(*pair) for pair in zip(*drawn, strict=True))


@pytest.mark.parametrize("dtype", FORMATS)
@pytest.mark.parametrize("size", [5, 16, 32, 64, 100])
def test_what_cannot_be_is_not_drawn(dtype, size):
    """At both ends of the uniform numbers, next to impossible classes, and far apart."""
    possible = th.tensor([size // 4, size - 2])
    for value in (-math.inf, -1e30, -1000.0, -95.0):
        logits = th.full((200, 1, size), value, dtype=dtype)
        logits[:, :, possible] = 0.0
        uniform = th.rand(200, 1)
        uniform[0], uniform[1], uniform[2] = 0.0, 1 - 2**-24, 1.0
        drawn = planner_ops.draws(logits, None, uniform, False, False)[0]
        assert th.equal(drawn.unique(), possible)
        assert drawn[:3].flatten().tolist() == [possible[0], possible[1], possible[1]]
    # Numbers beyond what exp can hold.
    logits = _numbers(50, 1, size, dtype=dtype) + 1000.0
    logits[:, :, 3] = 3e38
    assert (planner_ops.draws(logits, None, th.rand(50, 1), False, False)[0] == 3).all()


@pytest.mark.parametrize("size", [16, 32, 64, 100])
def test_impossible_classes_where_sums_are_rounded(size):
    """Uniform numbers next to each of the distribution's steps, where a running sum made in pieces may shrink a little."""
    logits = 2 * _numbers(300, size, seed=size)
    impossible = th.rand(300, size, generator=_generator(1)) < 0.6
    logits[impossible] = -math.inf
    logits[:, 1] = 0.0
    impossible[:, 1] = False
    for shift in range(-3, 4):
        uniform = (logits.double().softmax(-1).cumsum(-1).float() + shift * 2.0**-25).clamp(0, 1 - 2**-24)
        many = logits.unsqueeze(1).expand(-1, size, -1).contiguous()
        drawn = planner_ops.draws(many, None, uniform, False, False)[0]
        assert not impossible.gather(1, drawn).any()


@pytest.mark.parametrize("size", [5, 32, 100])
@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_what_is_not_a_number_shows_in_the_probabilities(size, bad):
    for place in range(0, size, 3):
        logits = _numbers(2, 3, size)
        logits[1, 2, place] = bad
        classes, probs = planner_ops.draws(logits, None, th.rand(2, 3), False, True)
        assert ((classes >= 0) & (classes < size)).all()
        assert probs[1, 2].isnan().all() and probs.isnan().sum() == size


def test_draws_of_the_agent():
    """Through the module of all draws, from its generator, with the frequencies asked for."""
    logits = _numbers(1, 2, 7).expand(20000, -1, -1).contiguous()
    drawn = [distributions.draw_classes_of_logits(logits, _generator(3)) for _ in range(2)]
    assert th.equal(*drawn) and not th.equal(drawn[0], distributions.draw_classes_of_logits(logits, _generator(4)))
    found = th.stack([(drawn[0] == c).float().mean(0).sum() for c in range(14)])
    assert th.allclose(found, logits[0].softmax(-1).flatten(), atol=0.015)


# -- sums of rows ----------------------------------------------------------------------------------------------------------


def _half() -> bool:
    return planner_ops.rows_format(th.bfloat16) == th.float16


@settings(deadline=None, max_examples=60)
@given(
    n=st.integers(0, 20),
    variables=st.integers(0, 9),
    width=st.one_of(st.integers(1, 70), st.sampled_from([200, 400, 416, 417, 1000])),
    others=st.integers(0, 4),
    dtype=st.sampled_from(FORMATS),
    half=st.booleans(),
    parts=st.tuples(*[st.booleans()] * 4),
)
def test_sums_of_rows(n, variables, width, others, dtype, half, parts):
    elu, with_bias, with_addend, in_place = parts
    stored = th.float16 if half and dtype == th.bfloat16 and _half() else dtype
    rows, other_rows, bias = (
        _numbers(*shape, seed=seed).to(stored)
        for seed, shape in enumerate([(3 * variables, width), (others, width), (width,)])
    )
    classes = th.randint(3, (n, variables)) + 3 * th.arange(variables)
    wide_x, addend = _numbers(n, others + 2, seed=5), _numbers(n, width, seed=6, dtype=dtype)
    x = wide_x[:, 1 : 1 + others]
    exact = rows.double()[classes].sum(1) + x.double() @ other_rows.double()
    exact = exact + (bias if with_bias else 0) + (addend if with_addend else 0)
    exact = F.elu(exact) if elu else exact
    room = th.full((n, width + 3), 7.0, dtype=dtype)
    out = addend.clone() if in_place and with_addend else room[:, 2:-1]
    planner_ops.gather(
        planner_ops.whole_lines(rows, stored),
        classes if variables else None,
        planner_ops.whole_lines(other_rows, stored) if others else None,
        x if others else None,
        planner_ops.whole_lines(bias, stored) if with_bias else None,
        out if in_place and with_addend else addend if with_addend else None,
        elu,
        out,
    )
    scale = 1 + rows.double().abs()[classes].sum(1)
    assert (
        (out - exact).abs() <= scale * (ROUNDING[dtype] if stored == dtype else 2**-10) + exact.abs() * ROUNDING[dtype]
    ).all()
    assert (room[:, :2] == 7).all() and (room[:, -1] == 7).all()


def test_rows_that_are_no_numbers_stay_so():
    for dtype in FORMATS:
        stored = planner_ops.rows_format(dtype)
        rows = _numbers(8, 40, dtype=dtype)
        rows[3, 38] = math.nan
        out = th.empty(2, 40, dtype=dtype)
        for elu in (False, True):
            classes = th.tensor([[0, 1, 2, 3, 4], [4, 5, 6, 7, 0]])
            planner_ops.gather(planner_ops.whole_lines(rows, stored), classes, None, None, None, None, elu, out)
            assert out.isnan().nonzero().tolist() == [[0, 38]]


# -- the GRU ---------------------------------------------------------------------------------------------------------------


@settings(deadline=None, max_examples=40)
@given(n=st.integers(0, 40), size=st.one_of(st.integers(1, 70), st.just(200)), dtype=st.sampled_from(FORMATS))
def test_gates(n, size, dtype):
    parts, weight, bias, old = (
        _numbers(*shape, seed=seed) for seed, shape in enumerate([(n, 3 * size), (3 * size,), (3 * size,), (n, size)])
    )
    parts = (3 * parts + 5).to(dtype)
    room = th.full((n, size + 3), 7.0, dtype=dtype)
    new = planner_ops.gates(parts, weight, bias, 1e-5, old, room[:, 2:-1])
    reset, candidate, update = F.layer_norm(parts.double(), (3 * size,), weight.double(), bias.double()).chunk(3, -1)
    exact = th.lerp(old.double(), (reset.sigmoid() * candidate).tanh(), (update - 1).sigmoid())
    assert new.dtype == th.float32 and th.allclose(new.double(), exact, atol=GATES[dtype])
    assert th.equal(room[:, 2:-1], new.to(dtype)) and (room[:, :2] == 7).all() and (room[:, -1] == 7).all()


def test_gates_far_out_and_what_is_not_a_number():
    parts = th.zeros(3, 96)
    parts[0, :48], parts[0, 48:] = 1e30, -1e30
    parts[1, 5] = math.nan
    old = _numbers(3, 32)
    new = planner_ops.gates(parts, th.full((96,), 1e4), th.zeros(96), 1e-5, old, th.empty(3, 32))
    assert new[0].isfinite().all() and new[1].isnan().all()
    assert th.allclose(new[2], old[2] * (1 - th.sigmoid(th.tensor(-1.0))))


# -- misuse ----------------------------------------------------------------------------------------------------------------


def test_what_kernels_do_not_take():
    logits, uniform, rows = th.zeros(2, 3, 4), th.zeros(2, 3), planner_ops.whole_lines(th.zeros(4, 5), th.float32)
    out, classes = th.zeros(2, 5), th.zeros(2, 3, dtype=th.int64)
    for words, call in {
        "uniform numbers must be": lambda: planner_ops.draws(logits, None, uniform[:1], True, False),
        "a bias must be": lambda: planner_ops.draws(logits, th.zeros(4), uniform, True, False),
        "one after the other": lambda: planner_ops.draws(logits.mT, None, th.zeros(2, 4), True, False),
        "nothing can be drawn": lambda: planner_ops.draws(logits[..., :0], None, uniform, True, False),
        "rows of weights must be": lambda: planner_ops.gather(th.zeros(4, 5), classes, None, None, None, None, False, out),
        "classes must be": lambda: planner_ops.gather(rows, classes.int(), None, None, None, None, False, out),
        "other inputs must be": lambda: planner_ops.gather(rows, None, rows, th.zeros(2, 3), None, None, False, out),
        "an addend must be": lambda: planner_ops.gather(rows, classes, None, None, None, th.zeros(5), False, out),
        "a result must be": lambda: planner_ops.gather(rows, classes, None, None, None, None, False, out.bfloat16()),
        "parts must be": lambda: planner_ops.gates(out, out, out, 1e-5, out, out),
    }.items():
        with pytest.raises(ValueError, match=words):
            call()
    with pytest.raises(TypeError, match="float64"):
        planner_ops.draws(logits.double(), None, uniform, True, False)


# -- the whole -------------------------------------------------------------------------------------------------------------


@pytest.fixture(params=METHODS, ids=str)
def agent(request, world_model):
    """With N environments' skills, and with layers that matter, unlike fresh ones."""
    return agent_and_skill(world_model, *request.param)


def _prepared(agent, skill, dtype) -> NativeAgent:
    with native.using("native", "cpu"):
        return NativeAgent(agent, skill, dtype)


def _start(rssm: RSSM, seed: int, n: int = N * M) -> LatentState:
    return LatentState(_numbers(n, rssm.stoch_size, seed=seed), _numbers(n, rssm.deter_size, seed=seed + 10))


def test_same_states_and_scores(agent, threads):
    plain, ready = PlannedAgent(*agent), _prepared(*agent, th.float32)
    assert isinstance(ready._dynamics, NativeDynamics) and isinstance(ready._value, NativeHead)
    check_states_and_scores(plain, ready, [_start(plain.agent.world_model.rssm, seed) for seed in (0, 1)], tolerance=1e-4)


def test_heads_without_hidden_layers(world_model):
    """Whose only layer reads states and what else there is, and gives the result."""
    its = Agent(world_model(net_arch=[]), [], None)
    state, action, scores = _start(its.world_model.rssm, 0), th.rand(N * M, 2), []
    with th.no_grad(), deterministic_draws():
        for ready in (PlannedAgent(its, th.zeros(1, 0)), *(_prepared(its, th.zeros(1, 0), dtype) for dtype in FORMATS)):
            features = ready.features([ready.step(state, action, None)])
            scores.append(th.stack([ready.rewards(features), ready.values(features)]))
    assert th.allclose(scores[0], scores[1], atol=1e-5) and th.allclose(scores[0], scores[2], atol=0.05)


def test_same_plan_of_the_same_random_numbers(agent):
    """The plain form draws with one uniform number a variable in the same order."""
    planner = DynaMPC(PlannerConfig(horizon=3, n_samples=40, iterations=3, top_k=5), 0.95)
    rssm = agent[0].world_model.rssm
    state, mean = _start(rssm, 0, N), th.zeros(N, 3, 2)
    with th.no_grad():
        (action, ours), (expected, theirs) = (
            planner.plan(model, state, mean, _generator(8), explore=True)
            for model in (_prepared(*agent, th.float32), PlannedAgent(*agent))
        )
        other = planner.plan(_prepared(*agent, th.float32), state, mean, _generator(9), explore=True)[0]
    assert th.allclose(ours, theirs, atol=1e-4) and th.allclose(action, expected, atol=1e-4)
    assert not th.allclose(action, other, atol=1e-2)


def test_short_products_stay_close(world_model):
    its = Agent(world_model(), [8, 8], None)
    check_short_products(lambda dtype: _prepared(its, th.zeros(1, 0), dtype), _start(its.world_model.rssm, 0))


def test_who_plans_with_them(agent, monkeypatch):
    def form(compile):
        with native.using(compile, "cpu"):
            return type(planned(*agent))

    assert form("eager") is PreparedAgent and form("auto") is NativeAgent
    monkeypatch.setattr(planner_ops, "fast", lambda: False)
    assert form("native") is PreparedAgent


def test_plans_do_not_depend_on_threads(agent):
    planner = DynaMPC(PlannerConfig(horizon=2, n_samples=600, iterations=2, top_k=5), 0.95)
    state, plans = _start(agent[0].world_model.rssm, 0, N), []
    for count in (1, 2):
        with th.no_grad(), threads_of(count):
            ready = _prepared(*agent, th.float32)
            plans.append(planner.plan(ready, state, th.zeros(N, 2, 2), _generator(1), explore=True)[1])
    assert th.allclose(*plans, atol=1e-4)
