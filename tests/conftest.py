"""What several test files share: a cheap environment, tiny agents, and comparisons of weights."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch as th
from fake_envs import CounterEnv
from gymnasium import spaces
from hypothesis import settings
from tiny import ACTIONS, IMAGE, LEARNER, threads_of

from sb3_dreamer_urlb import DreamerV2, native
from sb3_dreamer_urlb.agent import Agent
from sb3_dreamer_urlb.intrinsic import make_intrinsic_reward
from sb3_dreamer_urlb.learning.learner import Learner, LearnerConfig
from sb3_dreamer_urlb.native import build, planner_ops, product_ops
from sb3_dreamer_urlb.nn import activation, distributions
from sb3_dreamer_urlb.spaces.observations import Images
from sb3_dreamer_urlb.types import SequenceBatch
from sb3_dreamer_urlb.world_model import convolution, gru
from sb3_dreamer_urlb.world_model.world_model import WorldModel


def pytest_configure() -> None:
    """Tiny networks gain nothing from threads; hypothesis draws the same examples in every run."""
    th.set_num_threads(1)
    settings.register_profile("suite", deadline=None, derandomize=True, max_examples=25)
    settings.load_profile("suite")


@pytest.fixture
def seeded() -> None:
    """Fixed global torch randomness."""
    th.manual_seed(0)


@pytest.fixture
def tiny_model() -> Callable[..., DreamerV2]:
    """Make a tiny DreamerV2 on the counting environment, or on the one given."""

    def make(env: Any = None, policy: str = "CnnPolicy", **kwargs: Any) -> DreamerV2:
        env = CounterEnv() if env is None else env
        return DreamerV2(policy, env, **{"preset": "tiny", "seed": 0, "device": "cpu", **kwargs})

    return make


@pytest.fixture
def world_model(seeded: None) -> Callable[..., WorldModel]:
    """Make a tiny world model."""

    def make(**kwargs: Any) -> WorldModel:
        sizes = {
            "observations": Images(spaces.Box(0, 255, IMAGE, np.uint8)),
            "action_size": ACTIONS,
            "cnn_depth": 2,
            "deter_size": 8,
            "hidden_size": 8,
            "stoch_variables": 3,
            "stoch_classes": 4,
            "net_arch": [8],
            "gamma": 0.99,
            "discount_head": False,
        }
        return WorldModel(**{**sizes, **kwargs})

    return make


@pytest.fixture
def learner(world_model: Callable[..., WorldModel]) -> Callable[..., Learner]:
    """Make a learner with a tiny agent of its own."""

    def make(intrinsic: str | None = None, discount_head: bool = False, **kwargs: Any) -> Learner:
        kwargs_of_method = {"k": 3} if intrinsic in ("apt", "aps") else {}
        agent = Agent(world_model(discount_head=discount_head), [8], make_intrinsic_reward(intrinsic, kwargs_of_method))
        return Learner(agent, LearnerConfig(**{**LEARNER, **kwargs}))

    return make


@pytest.fixture
def batch(seeded: None) -> SequenceBatch:
    """Random rows, (B, T) = (3, 5)."""
    lead = (3, 5)
    is_first = th.zeros(lead, dtype=th.bool)
    is_first[:, 0] = True
    is_terminal = th.zeros(lead, dtype=th.bool)
    is_terminal[0, -1] = True
    observation = th.randint(0, 256, (*lead, *IMAGE), dtype=th.uint8)
    return SequenceBatch(observation, th.rand(*lead, ACTIONS) * 2 - 1, th.rand(lead), is_first, is_terminal)


@pytest.fixture(scope="module")
def kernels() -> None:
    """Where there is no compiler, there is nothing to test; where there is one, it must build them."""
    try:
        build.find_compiler()
    except build.NativeUnavailable as error:
        pytest.skip(str(error))
    assert native.why_not() is None


@pytest.fixture
def kernels_of_every_size(kernels: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Inside ``native.using()``, kernels of our own for tiny tensors, too, and on processors where torch's are faster."""
    monkeypatch.setattr(activation, "SMALLEST_NATIVE", 0)
    monkeypatch.setattr(activation, "SMALLEST_NATIVE_LEARNING", 0)
    monkeypatch.setattr(activation, "SMALLEST_NATIVE_GRADIENT", {th.float32: 0, th.bfloat16: 0})
    monkeypatch.setattr(distributions, "NATIVE_SIZE", 0)
    monkeypatch.setattr(product_ops, "ROWS", 1)
    monkeypatch.setattr(product_ops, "COLUMNS", 1)
    monkeypatch.setattr(convolution, "CHANNELS", 1)
    monkeypatch.setattr(gru, "NATIVE_ROWS", 1)
    monkeypatch.setattr(planner_ops, "fast", lambda: True)


@pytest.fixture(params=[1, 2])
def threads(request: pytest.FixtureRequest) -> Iterator[None]:
    """A test for each number of threads."""
    with threads_of(request.param):
        yield


def weights(module: th.nn.Module) -> dict[str, bytes]:
    """A module's parameters and buffers, bit for bit."""
    return {name: value.detach().cpu().numpy().tobytes() for name, value in module.state_dict().items()}


@pytest.fixture(name="weights")
def weights_fixture() -> Callable[[th.nn.Module], dict[str, bytes]]:
    """:func:`weights`."""
    return weights
