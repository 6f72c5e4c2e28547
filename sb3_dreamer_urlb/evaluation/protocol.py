"""Playing episodes: what evaluations, figures and the demo share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import gymnasium
import numpy as np
from stable_baselines3.common.type_aliases import PolicyPredictor
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_dreamer_urlb.number_checks import plain
from sb3_dreamer_urlb.snapshots.normalization import of_observations


class RandomPolicy:
    """Uniformly random actions, behind the interface of a model.

    :param action_space: Box
    :param seed: of the draws
    """

    def __init__(self, action_space: gymnasium.Space[Any], seed: int = 0):
        self.action_space = action_space
        self.action_space.seed(seed)

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """One action for one observation."""
        return self.action_space.sample(), None


@dataclass
class PlayedEpisode:
    """One episode as it was played.

    :param observations: as the model saw them, (steps + 1, …), by name for Dicts
    :param actions: as the environment received them, float (steps, A)
    :param total_reward: undiscounted return
    :param frames: large pictures, uint8, empty unless asked for
    :param rewards: of each step, float (steps,)
    """

    observations: np.ndarray | dict[str, np.ndarray]
    actions: np.ndarray
    total_reward: float
    frames: list[np.ndarray] = field(default_factory=list)
    rewards: np.ndarray = field(default_factory=lambda: np.empty(0))


def play_episode(
    model: PolicyPredictor, env: gymnasium.Env, seed: int | None = None, deterministic: bool = True, render: bool = False
) -> PlayedEpisode:
    """Play one episode, with the model's memory threaded through.

    :param model: anything with SB3's ``predict``; one that learnt behind ``VecNormalize`` sees what that makes of observations
    :param env: one environment, not vectorised
    :param seed: of the episode
    :param deterministic: handed to ``predict``
    :param render: also keep ``env.render()`` after each step
    :raises ValueError: for a vectorised environment, and a model whose ``VecNormalize`` nobody knows
    """
    if isinstance(env, VecEnv):
        raise ValueError(
            f"play_episode() and evaluate() take one environment, got the vectorised {type(env).__name__}: evaluate_policy of "
            "Stable-Baselines3 plays in these."
        )
    shown = _as_the_model_sees(model)
    observation = shown(env.reset(seed=plain(seed))[0])
    observations, actions, frames, rewards = [observation], [], [], []
    state: Any = None
    done = False
    start = np.ones(1, bool)
    while not done:
        action, state = model.predict(observation, state, start, deterministic)
        start = np.zeros(1, bool)
        given, reward, terminated, truncated, _ = env.step(action)
        observation = shown(given)
        done = terminated or truncated
        rewards.append(float(reward))
        observations.append(observation)
        actions.append(action)
        if render:
            frames.append(np.asarray(env.render()))
    return PlayedEpisode(stacked(observations), np.stack(actions), sum(rewards), frames, np.array(rewards))


def _as_the_model_sees(model: Any) -> Callable[[Any], Any]:
    """From an environment's observation to what a model learnt from."""
    get = getattr(model, "get_vec_normalize_env", None)
    normalizer: VecNormalize | None = get() if callable(get) else None
    if normalizer is not None:
        return normalizer.normalize_obs
    if getattr(model, "env", None) is None and of_observations(getattr(model, "loaded_statistics", {})):
        raise ValueError(
            "The model learnt from observations behind VecNormalize, and was loaded without an environment that has one: "
            "load(path, env=VecNormalize(...)), which takes the statistics over."
        )
    return lambda observation: observation


def stacked(observations: Sequence[Any]) -> np.ndarray | dict[str, np.ndarray]:
    """Observations in a row, (n, …), those of Dicts by name.

    :param observations: as one environment gave them, n
    """
    if isinstance(observations[0], dict):
        return {name: np.stack([one[name] for one in observations]) for name in observations[0]}
    return np.stack(observations)


def evaluate(model: PolicyPredictor, env: gymnasium.Env, episodes: int, seed: int = 1000) -> list[float]:
    """Returns of ``episodes`` episodes with fixed seeds, the same for everyone that is compared.

    :param model: anything with SB3's ``predict``
    :param env: one environment, not vectorised
    :param episodes: how many
    :param seed: of the first; the others follow
    """
    return [play_episode(model, env, seed=seed + i).total_reward for i in range(episodes)]
