"""Whoever asks for a learn() that cannot learn is told."""

import itertools
import re
from types import SimpleNamespace

import pytest
from fake_envs import CounterEnv
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import DummyVecEnv
from told import told_meanwhile

from sb3_dreamer_urlb import DrQv2
from sb3_dreamer_urlb.algorithm import updates_due


def told(model, steps: int, callback=None) -> list[str]:
    """What learn() warned of."""
    with told_meanwhile() as told_now:
        model.learn(steps, callback)
    return [text for text in told_now if "update" in text]


class Stops(BaseCallback):
    """At the first step."""

    def _on_step(self) -> bool:
        return False


class StopsAt(BaseCallback):
    """At some step."""

    def __init__(self, step: int):
        super().__init__()
        self.step = step

    def _on_step(self) -> bool:
        return self.n_calls < self.step


@given(
    st.integers(0, 30),
    st.integers(1, 7),
    st.integers(1, 3),
    st.lists(st.integers(1, 25), min_size=1, max_size=3),
    st.booleans(),
)
@settings(max_examples=40)
def test_a_warning_before_there_is_no_update_and_none_else(learning_starts, train_freq, n_envs, learns, pretrains):
    env = DummyVecEnv([lambda: CounterEnv(6)] * n_envs)
    reward = "disagreement" if pretrains else None
    model = DrQv2(
        "CnnPolicy", env, preset="tiny", intrinsic_reward=reward, train_freq=train_freq, learning_starts=learning_starts,
        gradient_steps=1, device="cpu", seed=0,
    )  # fmt: skip
    for steps in learns:
        before = model._n_updates
        messages = told(model, steps)
        assert len(messages) == (model._n_updates == before)
        for message in messages:
            if model.phase_timesteps <= learning_starts:
                assert message.startswith("This learn() will hold no update") and f"={learning_starts}: more" in message
            else:  # the very first update has no step to draw
                assert message.startswith("learn() has ended without an update") and "waits for a first step" in message
            assert f"after {model.phase_timesteps} agent steps of {model.phase}" in message


def test_what_is_only_known_at_the_end(tiny_model):
    model = tiny_model(CounterEnv(50), learning_starts=2)
    [message] = told(model, 20)
    assert message.startswith("learn() has ended without an update, after 20 agent steps") and "batch_length=" in message
    assert told(model, 60) == []
    episodes = tiny_model(CounterEnv(5), learning_starts=40, train_freq=(1, "episode"))
    [message] = told(episodes, 10)
    assert message.startswith("learn() has ended without an update") and "learning_starts=40" in message


@pytest.mark.parametrize("steps", [0, 8, 40])
def test_a_fine_tuning_of_fresh_networks_says_so(tiny_model, steps):
    model = tiny_model(intrinsic_reward="lbs")
    told(model, steps)
    with told_meanwhile() as told_now:
        model.fine_tune()
    said = [text for text in told_now if "has had no update in" in text]
    assert len(said) == (steps < 40) and all(f"in {steps * model.action_repeat} frames" in one for one in said)


@pytest.mark.parametrize("reason", ["no steps", "no updates wanted", "ended by a callback"])
def test_who_wants_none_is_left_in_peace(tiny_model, reason):
    model = tiny_model(learning_starts=0, gradient_steps=0 if reason == "no updates wanted" else 1)
    assert told(model, 0 if reason == "no steps" else 8, Stops() if reason.startswith("ended") else None) == []


@pytest.mark.parametrize(("hours", "told_of"), [(23.0, False), (50.0, True)])
def test_days_on_a_cpu_are_told_once(tiny_model, monkeypatch, hours, told_of):
    """By the pace of a few rollouts, of which the first does not count."""
    model = tiny_model(CounterEnv(5), learning_starts=10, train_freq=2)
    clock = itertools.count(0.0, 2 * hours * 3600 / 1000)
    monkeypatch.setattr(updates_due, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    stop = StopsAt(60)
    with told_meanwhile() as told_now:
        model.learn(1000, stop)
    long = [text for text in told_now if "hours" in text]
    assert len(long) == told_of
    if told_of:
        left = int(re.search(r"for (\d+) agent steps, on a CPU", long[0])[1])
        assert 940 < left < 1000 and f"another {hours * left / 1000:.0f} hours" in long[0] and "than 'tiny'" in long[0]


def test_what_callbacks_do_in_between_is_no_pace(tiny_model, monkeypatch):
    model = tiny_model(CounterEnv(5), learning_starts=10, train_freq=2)
    long_evaluations = iter([0.0, 1e6, 2e6, 2e6 + 1, 3e6])
    monkeypatch.setattr(updates_due, "time", SimpleNamespace(monotonic=lambda: next(long_evaluations)))
    with told_meanwhile() as told_now:
        model.learn(1000, StopsAt(60))
    assert not [text for text in told_now if "hours" in text]
