"""What an environment tells about itself beyond its spaces."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import gymnasium
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_dreamer_urlb.number_checks import is_integer, plain


def _is_count(value: Any) -> bool:
    return is_integer(value) and value >= 1


#: what is read of environments, and what it must be to mean what it means here: the names are common ones
FACTS: dict[str, tuple[Callable[[Any], bool], str]] = {
    "action_repeat": (_is_count, "a positive integer, environment frames an agent step"),
    "domain": (lambda value: isinstance(value, str), "the name of a domain"),
    "max_episode_steps": (_is_count, "a positive integer, agent steps an episode"),
    "task": (lambda value: isinstance(value, str), "the name of a task"),
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
    """After how many steps the environment ends an episode: what ends it first, of all that count; None where nothing tells.

    The environment's own number, its spec's (``gymnasium.make(..., max_episode_steps=...)``), and those of the wrappers.
    Of wrappers in other processes only the outermost is heard.
    """
    spec = env_attribute(env, "spec", None)
    counts = [env_fact(env, "max_episode_steps", None), env_attribute(env, "_max_episode_steps", None)]
    counts.append(getattr(spec, "max_episode_steps", None))
    for wrapper in getattr(spec, "additional_wrappers", ()):
        counts.append((wrapper.kwargs or {}).get("max_episode_steps"))
    if isinstance(env.unwrapped, DummyVecEnv):
        counts += _counts_of_wrappers(env.unwrapped.envs[0])
    return min((int(count) for count in map(plain, counts) if _is_count(count)), default=None)


def _counts_of_wrappers(env: gymnasium.Env[Any, Any]) -> list[Any]:
    """Of those that do not hand their arguments to the spec, or have none to hand them to."""
    counts = []
    while True:
        counts += [vars(env).get(name) for name in ("max_episode_steps", "_max_episode_steps")]
        if not isinstance(env, gymnasium.Wrapper):
            return counts
        env = env.env
