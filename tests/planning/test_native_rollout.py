"""Trajectories imagined in one pass are those of steps, number by number."""

from __future__ import annotations

import pytest
import torch as th
from hypothesis import example, given, settings
from hypothesis import strategies as st
from tiny import threads_of

from sb3_dreamer_urlb import native
from sb3_dreamer_urlb.native import product_ops, rollout_ops
from sb3_dreamer_urlb.planning.prepared.native_parts import NativeDynamics
from sb3_dreamer_urlb.types import LatentState
from sb3_dreamer_urlb.world_model.rssm import RSSM

FORMATS = [th.float32, th.bfloat16]


@pytest.fixture(scope="module", autouse=True)
def tiles(kernels):
    if not product_ops.available():
        pytest.skip("this processor has no tiles (AMX)")


def _generator(seed: int = 0) -> th.Generator:
    return th.Generator().manual_seed(seed)


def _dynamics(rssm: RSSM, dtype: th.dtype) -> NativeDynamics:
    """Fresh layers hardly differ from none: biases, norms and logits that matter."""
    with th.no_grad():
        for parameter in rssm.parameters():
            parameter.copy_(0.5 * th.randn(parameter.shape, generator=_generator(parameter.numel())))
        with native.using("native", "cpu"):
            return NativeDynamics(rssm, dtype)


def _start(rssm: RSSM, n: int) -> LatentState:
    return LatentState(*(th.randn(n, size, generator=_generator(size)) for size in (rssm.stoch_size, rssm.deter_size)))


@settings(deadline=None, max_examples=60)
@given(
    n=st.integers(1, 70),
    horizon=st.integers(1, 4),
    sizes=st.tuples(st.integers(1, 3), st.integers(1, 70), st.integers(1, 70), st.integers(1, 9)),
    classes=st.one_of(st.sampled_from([16, 32, 64]), st.integers(1, 40)),
    dtype=st.sampled_from(FORMATS),
    threads=st.sampled_from([1, 2]),
)
@example(n=700, horizon=3, sizes=(6, 40, 50, 5), classes=32, dtype=th.bfloat16, threads=2)
@example(n=700, horizon=2, sizes=(6, 40, 50, 5), classes=20, dtype=th.float32, threads=1)
def test_rollouts_are_steps(n, horizon, sizes, classes, dtype, threads):
    actions, deter, hidden, variables = sizes
    rssm = RSSM(actions, 7, deter, hidden, variables, classes)
    dynamics, state = _dynamics(rssm, dtype), _start(rssm, n)
    action = 2 * th.rand(n, horizon, actions, generator=_generator(1)) - 1
    with th.no_grad():
        generator, states = _generator(2), [state]
        for its in action.unbind(1):
            states.append(dynamics.step(states[-1], its, generator))
        with threads_of(threads):
            visited = dynamics.imagine(state, action, _generator(2))
    assert visited.classes.shape == (horizon, n, variables) and visited.short.dtype == dtype
    for t, expected in enumerate(states[1:]):
        assert th.equal(visited.classes[t], expected.classes) and th.equal(visited.short[t], expected.short)


def test_what_rollouts_do_not_take():
    rssm = RSSM(2, 7, 10, 12, 3, 4)
    dynamics, state = _dynamics(rssm, th.float32), _start(rssm, 5)
    layers = [dynamics.rows, dynamics.action_rows, dynamics.bias, *dynamics.gru.laid, *dynamics.gru.biases, *dynamics.norm]
    layers += [tensor for pair in zip(dynamics.logits.laid, dynamics.logits.biases, strict=True) for tensor in pair]
    good = [state.deter, th.zeros(5, 12), th.zeros(5, 3, 2), th.rand(3, 5, 3)]

    def call(place=None, instead=None, layer=None):
        given, its_layers = list(good), list(layers)
        if layer is None:
            given[place] = instead
        else:
            its_layers[layer] = instead
        return rollout_ops.rollout(*given, its_layers, 1e-5)

    for words, arguments in {
        "a start must be": {"place": 0, "instead": state.deter.double()},
        "an addend must be": {"place": 1, "instead": th.zeros(4, 12)},
        "actions must be": {"place": 2, "instead": th.zeros(6, 3, 2)},
        "uniform numbers must be": {"place": 3, "instead": th.zeros(3, 4, 3)},
        "of 5 variables": {"place": 3, "instead": th.zeros(3, 5, 5)},
        "rows of weights must be": {"layer": 0, "instead": th.zeros(12, 12)},
        "other rows must be": {"layer": 1, "instead": layers[1][:1]},
        "a bias must be": {"layer": 2, "instead": th.zeros(12)},
        "not laid out for 22 inputs": {"layer": 3, "instead": layers[3][:-1]},
        "a GRU's bias": {"layer": 4, "instead": th.zeros(29)},
        "a norm's weight": {"layer": 5, "instead": th.zeros(10)},
        "a norm's bias": {"layer": 6, "instead": th.zeros(10)},
        "not laid out for 10 inputs": {"layer": 7, "instead": layers[7][:-1]},
        "a bias of logits": {"layer": 10, "instead": th.zeros(11)},
    }.items():
        with pytest.raises(ValueError, match=words):
            call(**arguments)
    with pytest.raises(TypeError, match=r"rows of weights must be torch\.float32"):
        call(layer=0, instead=layers[0].bfloat16())
