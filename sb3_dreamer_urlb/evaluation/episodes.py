"""The one evaluation: so many episodes in any VecEnv, with fixed seeds, with or without the planner (paper §2, §4).

The callback, ``sb3-dreamer-urlb evaluate`` and whoever else scores an agent play it.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.type_aliases import GymEnv, PolicyPredictor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_dreamer_urlb.evaluation.recording import copy_statistics, env_to_play_in
from sb3_dreamer_urlb.number_checks import check_integer
from sb3_dreamer_urlb.planning import planner_name

#: of the paper
EPISODES = 10
#: of the first episode; the others follow. The same for all that are compared.
SEED = 1000

#: who acts: what the model itself would do, the planner, the actor alone
AUTO, ON, OFF = "auto", "on", "off"
PLANNERS = (AUTO, ON, OFF)


@dataclass
class Evaluation:
    """What came of an evaluation.

    :param returns: undiscounted, of each episode, in the order of the seeds; never normalised
    :param lengths: agent steps of each
    :param planner: that acted, ``none`` for the actor alone
    :param seconds: that it took
    :param seed: of the first episode
    :param deterministic: whether the agent took its best actions; else it explored
    """

    returns: list[float]
    lengths: list[int]
    planner: str
    seconds: float
    seed: int
    deterministic: bool = True

    @property
    def mean(self) -> float:
        """Mean return."""
        return float(np.mean(self.returns))

    @property
    def std(self) -> float:
        """Standard deviation over the episodes, as Stable-Baselines3 gives it (ddof 0)."""
        return float(np.std(self.returns))


def run_evaluation(
    model: PolicyPredictor,
    env: GymEnv | str,
    episodes: int = EPISODES,
    seed: int = SEED,
    planner: str = AUTO,
    deterministic: bool = True,
) -> Evaluation:
    """Play episodes in all environments of a VecEnv at once.

    Episode ``i`` is the one that the environment's seed ``seed + i`` begins, however many environments there are; only the
    agent's own draws (posterior, planner) are those of a batch of that size. Global
    random generators are left as they were; the environment is left reset. Statistics of a ``VecNormalize`` are the model's
    and do not move; returns are the task's own.

    :param model: anything with SB3's ``predict``
    :param env: to play in, not the one that the model trains in; of one that is not vectorised, or an id, a VecEnv is made
    :param episodes: how many
    :param seed: of the first
    :param planner: ``"auto"`` as the model would act now, ``"on"``, ``"off"`` for the actor alone
    :param deterministic: handed to ``predict``
    :raises ValueError: for a number of episodes that is not positive, an unknown ``planner``, or ``"on"`` without one
    """
    check_integer("episodes", episodes, 1)
    check_integer("seed", seed, 0)
    env = as_played(model, env)
    actor, name = _acting(model, planner)
    device = getattr(model, "device", th.device("cpu"))
    began = time.perf_counter()
    played: list[tuple[float, int]] = []
    with _statistics_fixed(model, env), th.random.fork_rng([device] if device.type == "cuda" else []):
        th.manual_seed(seed)
        while len(played) < episodes:
            count = min(env.num_envs, episodes - len(played))
            played += _first_episodes(actor, env, count, seed + len(played), deterministic)
    returns, lengths = ([episode[part] for episode in played] for part in (0, 1))
    return Evaluation(returns, [int(length) for length in lengths], name, time.perf_counter() - began, seed, deterministic)


def as_played(model: Any, env: GymEnv | str) -> VecEnv:
    """An environment as a model is evaluated in it: a VecEnv as it is, another one vectorised, and normalised as the model's.

    :param model: that is to play
    :param env: vectorised or not, or its id
    :raises ValueError: for what does not fit the model
    """
    if isinstance(env, VecEnv):
        return env
    if hasattr(model, "loaded_statistics"):
        return env_to_play_in(model, env)
    one: Any = maybe_make_env(env, 0)
    return DummyVecEnv([lambda: one if is_wrapped(one, Monitor) else Monitor(one)])


def expected(
    model: PolicyPredictor, episodes: int = EPISODES, seed: int = SEED, planner: str = AUTO, deterministic: bool = True
) -> Evaluation:
    """What :func:`run_evaluation` will be about, its returns NaN: for who asks whether its row will be welcome.

    :param model: see :func:`run_evaluation`, as all others
    """
    return Evaluation([np.nan] * episodes, [0] * episodes, _acting(model, planner)[1], 0.0, seed, deterministic)


def _first_episodes(
    model: PolicyPredictor, env: VecEnv, count: int, seed: int, deterministic: bool
) -> list[tuple[float, int]]:
    """Return and length of the first episode in each of the first ``count`` environments."""
    env.seed(seed)
    observation: Any = env.reset()
    state: Any = None
    start = np.ones(env.num_envs, bool)
    returns, lengths = np.zeros(env.num_envs), np.zeros(env.num_envs, int)
    going = np.arange(env.num_envs) < count
    normalizer = unwrap_vec_normalize(env)
    while going.any():
        action, state = model.predict(observation, state, start, deterministic)
        observation, reward, start, infos = env.step(action)
        returns += going * (reward if normalizer is None else normalizer.get_original_reward())
        lengths += going
        for i in np.flatnonzero(going & start):
            # What a Monitor saw, below wrappers that change rewards.
            returns[i] = infos[i].get("episode", {}).get("r", returns[i])
        going &= ~start
    return [(float(returns[i]), int(lengths[i])) for i in range(count)]


@contextmanager
def _statistics_fixed(model: Any, env: VecEnv) -> Iterator[None]:
    normalizer = unwrap_vec_normalize(env)
    if normalizer is None:
        yield
        return
    if callable(getattr(model, "get_vec_normalize_env", None)):
        copy_statistics(model, env)
    # A VecNormalize within another one would move, too.
    held: list[tuple[VecNormalize, bool]] = []
    layer: Any = env
    while layer is not None:
        if isinstance(layer, VecNormalize):
            held.append((layer, layer.training))
            layer.training = False
        layer = getattr(layer, "venv", None)
    try:
        yield
    finally:
        for layer, training in held:
            layer.training = training


class _Chosen:
    """A model that plans, or does not, whatever it would do itself."""

    def __init__(self, model: Any, planning: bool):
        self.policy, self.planning = model.policy, planning

    def predict(self, *arguments: Any) -> Any:
        """As the policy's, which keeps the switch where it was."""
        before, self.policy.planning = self.policy.planning, self.planning
        try:
            return self.policy.predict(*arguments)
        finally:
            self.policy.planning = before


def without_planner(model: Any) -> str:
    """What to say of ``planner="on"`` to who has none."""
    if hasattr(model, "planner"):
        return "planner='on': the model has none; load it with planner='dyna_mpc', say."
    return f"planner='on': {type(model).__name__} has no planner."


def _acting(model: Any, planner: str) -> tuple[PolicyPredictor, str]:
    """Who is asked for actions, and the name of its planner."""
    if planner not in PLANNERS:
        raise ValueError(f"planner must be one of {PLANNERS}, got {planner!r}.")
    name = planner_name(getattr(model, "planner", None))
    if planner == ON and name is None:
        raise ValueError(without_planner(model))
    plans = name is not None and (planner == ON or (planner == AUTO and model._planner_is_on()))
    chosen = model if name is None or planner == AUTO else _Chosen(model, plans)
    return chosen, str(name) if plans else "none"
