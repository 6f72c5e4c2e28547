"""What one environment tells about itself, read where it lives, and sent from there only if it can be sent.

An environment in another process may have attributes that no pickle can hold (a lock, a function in its spec), or properties
that raise. Asked for one of these, a worker of SB3's ``SubprocVecEnv`` ends. So a visitor asks in its stead.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import gymnasium

from sb3_dreamer_urlb.envs.visiting import Visitor
from sb3_dreamer_urlb.number_checks import is_integer, plain


def is_count(value: Any) -> bool:
    """Whether a value counts something: 1, 2, …"""
    return is_integer(value) and value >= 1


#: what is read of environments, and what it must be to mean what it means here: the names are common ones
FACTS: dict[str, tuple[Callable[[Any], bool], str]] = {
    "action_repeat": (is_count, "a positive integer, environment frames an agent step"),
    "domain": (lambda value: isinstance(value, str), "the name of a domain"),
    "max_episode_steps": (is_count, "a positive integer, agent steps an episode"),
    "task": (lambda value: isinstance(value, str), "the name of a task"),
    "never_terminates": (lambda value: isinstance(value, bool), "True or False"),
    "reward_free": (lambda value: isinstance(value, bool), "True or False"),
}
#: gymnasium's own that are read, too
OF_GYMNASIUM = ("spec", "metadata")
#: steps after which an episode ends, whoever ends it
STEPS = "steps_an_episode"
#: name of the class of the environment itself
CLASS = "unwrapped_class"
#: attribute of the outermost wrapper with what was told
TOLD = "_told_in_its_process"


@dataclass(frozen=True)
class Foreign:
    """Stands for a value that cannot be read or sent, or means another thing here.

    :param text: what it is, for a message
    """

    text: str


def tell(env: gymnasium.Env[Any, Any]) -> dict[str, Any]:
    """Facts, what is Gymnasium's, and ``STEPS``, by name; None for what is not there.

    :param env: with its wrappers, in this process
    """
    told = {name: _read(env.get_wrapper_attr, name) for name in (*FACTS, *OF_GYMNASIUM)}
    part: Any = env
    counts = []
    while part is not None:
        counts += [_read(part.__getattribute__, name) for name in ("max_episode_steps", "_max_episode_steps")]
        part = part.env if isinstance(part, gymnasium.Wrapper) else None
    told[STEPS] = fewest_steps(told, counts)
    told[CLASS] = type(env.unwrapped).__name__
    return told


def _read(get: Callable[[str], Any], name: str) -> Any:
    try:
        return plain(get(name))
    except AttributeError:
        return None
    except Exception as error:
        return Foreign(f"a property that raises {type(error).__name__}: {str(error)[:40]}")


def fewest_steps(told: dict[str, Any], of_wrappers: Sequence[Any] = ()) -> int | None:
    """What ends an episode first, of all that count; None where nothing does.

    :param told: values by the names of Gymnasium's spec and of numbers of steps
    :param of_wrappers: further numbers, of wrappers that do not hand their arguments to the spec
    """
    spec = told["spec"]
    counts = [
        told["max_episode_steps"],
        told.get("_max_episode_steps"),
        getattr(spec, "max_episode_steps", None),
        *of_wrappers,
    ]
    counts += [(wrapper.kwargs or {}).get("max_episode_steps") for wrapper in getattr(spec, "additional_wrappers", ())]
    return min((int(count) for count in map(plain, counts) if is_count(count)), default=None)


class Asked(metaclass=Visitor):
    """An environment that was visited has told all, under the name ``TOLD``."""

    @staticmethod
    def visit(env: gymnasium.Env[Any, Any]) -> None:
        """Let it tell."""
        vars(env)[TOLD] = {name: _as_sent(name, value) for name, value in tell(env).items()}


def _as_sent(name: str, value: Any) -> Any:
    """What every process can read; what is Gymnasium's as a pickle, which may hold classes that only its own process knows."""
    if value is None or isinstance(value, Foreign) or name == STEPS:
        return value
    if name in FACTS:
        return value if FACTS[name][0](value) else Foreign(shown(value))
    try:
        return pickle.dumps(value)
    except Exception as error:
        return Foreign(f"nothing that can be sent to another process ({error})")


def as_received(value: Any) -> Any:
    """Undo the way through a process."""
    if not isinstance(value, bytes):
        return value
    try:
        return pickle.loads(value)
    except Exception as error:
        return Foreign(f"nothing that this process can read ({error})")


def shown(value: Any) -> str:
    """A value in a message."""
    try:
        text = value.text if isinstance(value, Foreign) else repr(value)
    except Exception:
        text = f"an object of the class {type(value).__name__}"
    return text if len(text) <= 80 else f"{text[:77]}..."
