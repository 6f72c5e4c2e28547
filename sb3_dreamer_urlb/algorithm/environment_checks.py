"""What is taken for an environment, whether a model has one, and whether it can go on in another one."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, unwrap_vec_normalize

from sb3_dreamer_urlb.envs.normalized import hides_originals
from sb3_dreamer_urlb.envs.registration import naming_near_ids
from sb3_dreamer_urlb.spaces.comparing import check_same_spaces
from sb3_dreamer_urlb.spaces.errors import UnsupportedSpaceError


class MissingEnvironmentError(ValueError, AssertionError):
    """A model that was loaded without an environment is to step in one.

    A ``ValueError`` like every other mistake of a caller, and the ``AssertionError`` that Stable-Baselines3 has for it.
    """


def given_env(env: Any, argument: str = "env") -> GymEnv:
    """What a user gave as an environment, wherever one is taken: before Stable-Baselines3 wraps it, and makes arrays for its
    observations.

    :param env: an environment, vectorised or not, or its id
    :param argument: what the user calls it, for messages
    :return: the environment; of an id, one that can be filmed where it knows how
    :raises UnsupportedSpaceError: for observations that no array can hold: Text, Sequence, Graph
    :raises ValueError: for environments that Gymnasium vectorised, and for what is no environment
    """
    if isinstance(env, type):
        raise ValueError(f"{argument} must be an environment, got the class {env.__qualname__}: {env.__qualname__}() is one.")
    if not isinstance(env, str) and not hasattr(env, "step"):
        raise ValueError(f"{argument} must be an environment of Gymnasium, a VecEnv or an id, got {env!r}.")
    with naming_near_ids(str(env)):
        env = maybe_make_env(env, 0)
    if isinstance(env, gymnasium.vector.VectorEnv):
        raise ValueError(
            f"{argument} is vectorised by Gymnasium, a {type(env).__name__}, which resets otherwise than Stable-Baselines3 "
            "does: make it with make_vec_env, DummyVecEnv or SubprocVecEnv of stable_baselines3."
        )
    space = getattr(env, "observation_space", None)
    check_equal_spaces(env, argument)
    parts = space.spaces.items() if isinstance(space, spaces.Dict) else [("", space)]
    for name, part in parts:
        if name and isinstance(part, spaces.Dict | spaces.Tuple):
            raise UnsupportedSpaceError(
                f"The observation {name!r} must be an array, got {part}: gymnasium.wrappers.FlattenObservation makes one of "
                "what is nested."
            )
        if isinstance(part, spaces.Space) and not isinstance(part, spaces.Dict | spaces.Tuple) and part.shape is None:
            which = f"The observation {name!r} must be an array" if name else "Observations must be arrays"
            raise UnsupportedSpaceError(f"{which} of numbers, or several by name in a Dict, got {part}.")
    return env  # type: ignore[no-any-return]


def check_equal_spaces(env: Any, argument: str) -> None:
    """Whether the environments of a VecEnv are alike, as far as they are in this process; a VecEnv looks at the first only.

    :param env: vectorised or not
    :param argument: see :func:`given_env`
    :raises ValueError: naming the first that has other spaces
    """
    inner = env.unwrapped if isinstance(env, VecEnv) else None
    envs = inner.envs if isinstance(inner, DummyVecEnv) else []
    for i, one in enumerate(envs):
        for name in ("observation_space", "action_space"):
            first, its = getattr(envs[0], name), getattr(one, name)
            if its != first:
                raise ValueError(f"{argument} must have one {name}: environment {i} has {its}, environment 0 {first}.")


def check_keeps_fractions(env: VecEnv) -> None:
    """
    :param env: vectorised
    :raises UnsupportedSpaceError: where a wrapper outside of VecNormalize says that observations are whole numbers
    """
    normalizer = unwrap_vec_normalize(env)
    if normalizer is None or not normalizer.norm_obs or not hides_originals(env, normalizer):
        return
    space: Any = env.observation_space
    for part in space.spaces.values() if isinstance(space, spaces.Dict) else [space]:
        if isinstance(part, spaces.Box) and not np.issubdtype(part.dtype, np.floating):
            raise UnsupportedSpaceError(
                f"VecNormalize gives fractions, and the wrapper outside of it says that they are {part.dtype}: {part}. "
                "Put VecNormalize outermost, or let the environment give float32."
            )


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
