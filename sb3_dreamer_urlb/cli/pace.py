"""How long a run will take on this machine, from a few of its parts; and a shorter one where that is too long."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import gymnasium
import numpy as np
import torch as th

from sb3_dreamer_urlb.dreamer_v2 import DreamerV2
from sb3_dreamer_urlb.types import SequenceBatch
from sb3_dreamer_urlb.words import counted


@dataclass(frozen=True)
class Pace:
    """Seconds that the parts of a run take.

    :param update: of the agent
    :param plan: a planned action, with what the agent sees before it; of all environments that are planned for at once
    :param act: the actor's action, likewise
    :param step: a step of the environment, drawn
    """

    update: float
    plan: float
    act: float
    step: float


@dataclass(frozen=True)
class Amount:
    """What a run does.

    :param steps: agent steps
    :param updates: of the agent
    :param plans: planned actions among the steps
    """

    steps: int
    updates: int
    plans: int

    def __add__(self, other: Amount) -> Amount:
        return Amount(self.steps + other.steps, self.updates + other.updates, self.plans + other.plans)

    def seconds(self, pace: Pace) -> float:
        """How long it takes."""
        acting = self.plans * pace.plan + (self.steps - self.plans) * pace.act
        return self.steps * pace.step + acting + self.updates * pace.update


#: share of the learning that must be done for a pace: of a warm-up's last moments and the first updates there is none
ENOUGH = 0.04


@dataclass
class Left:
    """What is left of a run that learns and then plays: as was expected, times how much slower it has been so far.

    :param learning: seconds expected until so many frames are learnt
    :param after: seconds expected of what comes after all of them
    :param total: frames
    """

    learning: Callable[[int], float]
    after: float
    total: int
    #: frames and time of the first look: what comes before it, processes that start, is no pace
    first: tuple[int, float] | None = None

    def seconds(self, frames: int, now: float) -> float | None:
        """
        :param frames: learnt by now
        :param now: in seconds, of any clock
        :return: how long it will still take; None at the first look, and until there is a pace
        """
        if self.first is None:
            self.first = frames, now
        done, began = self.first
        expected = self.learning(frames) - self.learning(done)
        if expected <= 0 or expected < ENOUGH * self.learning(self.total):
            return None
        return (now - began) / expected * (self.learning(self.total) - self.learning(frames) + self.after)


def phase(model: DreamerV2, frames: int, plans: bool) -> Amount:
    """What one phase does.

    :param model: whose warm-ups and frequency of updates count
    :param frames: of the environment
    :param plans: whether the planner acts once it is due
    """
    steps = -(-frames // model.action_repeat)
    learning = max(0, steps - model.learning_starts)
    updates = learning // model.train_freq.frequency * max(model.gradient_steps, 1)  # type: ignore[union-attr]
    return Amount(steps, updates, max(0, learning - model.planner_delay) if plans else 0)


def measure(model: DreamerV2, env: gymnasium.Env, planned: int = 1, repeat: int = 2) -> Pace:
    """Time the parts of a run: the best of some, after one that does not count.

    :param model: learns, so it is one that nobody needs
    :param env: one environment of its kind
    :param planned: environments that are planned for at once
    :param repeat: how often each part is timed
    """
    policy, batch = model.policy, _batch(model)
    assert isinstance(batch.observation, th.Tensor)  # pixels or a vector
    seen = batch.observation[0, :1]

    def act(plans: bool) -> None:
        rows = planned if plans else 1
        policy.planning = plans
        first = th.ones(rows, dtype=th.bool, device=model.device)
        beginning = policy.initial_state(rows)
        policy.choose(policy.observe(seen.expand(rows, *seen.shape[1:]), beginning, first), deterministic=False)

    def step() -> None:
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()

    env.reset(seed=0)
    update = _best(lambda: model.learner.update(batch), repeat)
    plan, actor = (_best(lambda plans=plans: act(plans), repeat) for plans in (True, False))  # type: ignore[misc]
    return Pace(update, plan, actor, _best(step, 5 * repeat))


def shrink(seconds: Callable[[float], float], limit: float, least: float) -> float:
    """The largest share of a run that takes no longer than some time.

    :param seconds: that a share of it takes, growing
    :param limit: in seconds
    :param least: smallest share that makes sense; taken where even that takes longer
    :return: in [least, 1]; 1 where all of it fits
    """
    if seconds(1.0) <= limit:
        return 1.0
    low, high = least, 1.0
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (middle, high) if seconds(middle) <= limit else (low, middle)
    return low


def in_words(seconds: float) -> str:
    """A duration, for people."""
    if seconds < 90:
        return f"about {counted(max(1, round(seconds)), 'second')}"
    if seconds < 5400:
        return f"about {round(seconds / 60)} minutes"
    return f"about {seconds / 3600:.1f} hours"


def _batch(model: DreamerV2) -> SequenceBatch:
    """Noise in the form of a replayed batch."""
    space, lead = model.observation_space, (model.batch_size, model.batch_length)
    first = th.zeros(lead, dtype=th.bool)
    first[:, 0] = True
    shape = (*lead, *(space.shape or ()))
    seen = th.randint(0, 256, shape, dtype=th.uint8) if space.dtype == np.uint8 else th.randn(shape)
    action = th.rand(*lead, model.policy.actions.size) * 2 - 1
    parts = (seen, action, th.rand(lead), first, th.zeros(lead, dtype=th.bool))
    return SequenceBatch(*(part.to(model.device) for part in parts))


def _best(work: Callable[[], object], repeat: int) -> float:
    times = []
    for _ in range(repeat + 1):
        began = time.perf_counter()
        work()
        times.append(time.perf_counter() - began)
    return max(min(times[1:]), math.ulp(1.0))
