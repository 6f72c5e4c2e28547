"""What an environment tells about itself beyond its spaces."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from sb3_dreamer_urlb.number_checks import is_integer, plain


def _is_count(value: Any) -> bool:
    return is_integer(value) and value >= 1


#: what is read of environments, and what it must be to mean what it means here: the names are common ones
FACTS: dict[str, tuple[Callable[[Any], bool], str]] = {
    "action_repeat": (_is_count, "a positive integer, environment frames an agent step"),
    "domain": (lambda value: isinstance(value, str), "the name of a domain"),
    "max_episode_steps": (_is_count, "a positive integer, agent steps an episode"),
    "never_terminates": (lambda value: isinstance(value, bool), "True or False"),
}


def env_fact(env: VecEnv, name: str, default: Any) -> Any:
    """A fact of ``FACTS`` as the environment tells it; ``default``, after a warning, where the name means another thing.

    :param env: of which the first is asked
    :param name: a key of ``FACTS``
    :param default: where there is none, or it is None
    """
    value = plain(env_attribute(env, name, None))
    if value is None:
        return default
    fits, expected = FACTS[name]
    if fits(value):
        return value
    text = repr(value) if len(repr(value)) <= 80 else f"{repr(value)[:77]}..."
    warnings.warn(f"The environment's attribute {name} is {text}, here it would be {expected}: it is not read.")
    return default


def env_attribute(env: VecEnv, name: str, default: Any) -> Any:
    """An attribute of the first environment, through all wrappers; ``default`` where there is none."""
    # Asking a SubprocVecEnv for an attribute that is not there would end its processes.
    return env.get_attr(name, indices=0)[0] if env.has_attr(name) else default


def steps_an_episode(env: VecEnv) -> int | None:
    """After how many steps the environment ends an episode; None where it does not tell."""
    steps = env_fact(env, "max_episode_steps", None)
    if steps is None:
        steps = plain(getattr(env_attribute(env, "spec", None), "max_episode_steps", None))
    return steps if _is_count(steps) else None
