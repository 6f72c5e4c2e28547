"""What an environment tells about itself beyond its spaces."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.vec_env import VecEnv


def env_attribute(env: VecEnv, name: str, default: Any) -> Any:
    """An attribute of the first environment, through all wrappers; ``default`` where there is none."""
    # Asking a SubprocVecEnv for an attribute that is not there would end its processes.
    return env.get_attr(name, indices=0)[0] if env.has_attr(name) else default


def steps_an_episode(env: VecEnv) -> int | None:
    """After how many steps the environment ends an episode; None where it does not tell."""
    steps = env_attribute(env, "max_episode_steps", None)
    if steps is None:
        steps = getattr(env_attribute(env, "spec", None), "max_episode_steps", None)
    return None if steps is None else int(steps)
