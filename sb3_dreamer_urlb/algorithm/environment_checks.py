"""Whether a model has an environment, and one that it can go on in."""

from __future__ import annotations

from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from sb3_dreamer_urlb.spaces.comparing import check_same_spaces


class MissingEnvironmentError(ValueError, AssertionError):
    """A model that was loaded without an environment is to step in one.

    A ``ValueError`` like every other mistake of a caller, and the ``AssertionError`` that Stable-Baselines3 has for it.
    """


def needed_env(model: Any, caller: str) -> VecEnv:
    """The environments of a model.

    :param model: that is to step in them, or to reset them
    :param caller: what was called
    :raises MissingEnvironmentError: if there is none
    """
    if model.env is None:
        me = type(model).__name__
        raise MissingEnvironmentError(
            f"{caller}() needs an environment, and this model has none, as it was loaded without: model.set_env(env) gives it "
            f"one, and so do {me}.load(path, env=env) and {me}.resume(folder, env=env)."
        )
    env: VecEnv = model.env
    return env


def check_env(model: Any, env: VecEnv) -> None:
    """Whether a model can go on in another environment.

    :param model: with its spaces
    :param env: vectorised
    :raises AssertionError: for another number of environments, as SB3's ``set_env``
    :raises ValueError: for other spaces
    """
    if env.num_envs != model.n_envs:
        raise AssertionError(
            f"The number of environments differs from the model's: {env.num_envs} != {model.n_envs}. "
            f"To change it, load a snapshot with the new ones: {type(model).__name__}.load(path, env=...)."
        )
    check_same_spaces(env, model)
