"""What an environment tells about itself beyond its spaces."""

from __future__ import annotations

import warnings
from typing import Any

from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnv

from sb3_dreamer_urlb.envs.supervisor import SupervisedVecEnv
from sb3_dreamer_urlb.envs.told import FACTS, STEPS, TOLD, Asked, Foreign, as_received, fewest_steps, shown, tell
from sb3_dreamer_urlb.envs.visiting import visited
from sb3_dreamer_urlb.number_checks import plain


def env_fact(env: VecEnv, name: str, default: Any) -> Any:
    """A fact of ``FACTS`` as the environment tells it; ``default``, after a warning, where the name means another thing.

    :param env: of which the first is asked
    :param name: a key of ``FACTS``
    :param default: where there is none, or it is None
    """
    value = _told(env, name)
    if value is None:
        return default
    fits, expected = FACTS[name]
    if fits(value):
        return value
    warnings.warn(f"The environment's attribute {name} is {shown(value)}, here it would be {expected}: it is not read.")
    return default


def env_attribute(env: VecEnv, name: str, default: Any) -> Any:
    """An attribute of the first environment, through all wrappers; ``default`` where there is none that can be had.

    :param env: of which the first is asked
    :param name: of those that are Gymnasium's, ``"spec"``, ``"metadata"``; a key of ``FACTS``, or ``CLASS``
    :param default: instead
    """
    value = _told(env, name)
    return default if value is None or isinstance(value, Foreign) else value


def steps_an_episode(env: VecEnv) -> int | None:
    """After how many steps the environment ends an episode: what ends it first, of all that count; None where nothing tells.

    The environment's own number, its spec's (``gymnasium.make(..., max_episode_steps=...)``), and those of the wrappers.

    :param env: of which the first is asked
    """
    steps: int | None = _told(env, STEPS)
    return steps


def _told(env: VecEnv, name: str) -> Any:
    """What the first environment tells by this name; None where there is nothing."""
    innermost = env.unwrapped
    if isinstance(innermost, DummyVecEnv):
        return tell(innermost.envs[0])[name]
    if isinstance(innermost, SubprocVecEnv | SupervisedVecEnv) and visited(innermost, Asked, indices=0):
        return as_received(innermost.get_attr(TOLD, indices=0)[0][name])
    # One without a wrapper cannot be asked so, and others' VecEnvs may know of no wrappers.
    if name != STEPS:
        return _asked_for(env, name)
    names = ("max_episode_steps", "_max_episode_steps", "spec")
    return fewest_steps({each: _asked_for(env, each) for each in names})


def _asked_for(env: VecEnv, name: str) -> Any:
    """
    :raises RuntimeError: if the environment's process ends by the question
    """
    try:
        # Asking a SubprocVecEnv for an attribute that is not there would end its processes.
        return plain(env.get_attr(name, indices=0)[0]) if env.has_attr(name) else None
    except (EOFError, ConnectionError) as error:
        raise RuntimeError(
            f"The environment's process ended when it was asked for the attribute {name!r}: it raises, or cannot be sent to "
            "another process. Wrap the environment in stable_baselines3's Monitor, then it can be asked without."
        ) from error
