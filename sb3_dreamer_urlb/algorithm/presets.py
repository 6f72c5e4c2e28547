"""Named sets of hyperparameters: they replace defaults of a constructor, never what a user writes out."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Any

from sb3_dreamer_urlb.number_checks import check_dict, is_choice, plain
from sb3_dreamer_urlb.unknown_names import did_you_mean, unexpected_arguments

Presets = dict[str, dict[str, Any]]
#: of constructors, what no message proposes
HIDDEN = ("self", "_init_setup_model")
#: dictionaries that a user's own extend instead of replacing them
MERGED = ("policy_kwargs", "planner_kwargs", "replay_buffer_kwargs")


def with_presets(
    presets: Presets, left_alone: Callable[[str, Mapping[str, Any]], bool] | None = None
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Let a constructor's ``preset`` argument replace the defaults of the arguments that the caller left out.

    :param presets: by name
    :param left_alone: tells of an argument's name and the arguments that were given whether the preset does not touch it
    :return: wraps an ``__init__``, which keeps its signature
    """

    def wrap(init: Callable[..., None]) -> Callable[..., None]:
        signature = inspect.signature(init)
        known = [name for name in signature.parameters if name not in HIDDEN]
        listed = init.__qualname__.split(".")[0]

        @functools.wraps(init)
        def wrapped(*args: Any, **kwargs: Any) -> None:
            args, kwargs = plain(args), plain(kwargs)
            if unknown := [name for name in kwargs if name not in signature.parameters]:
                kind = type(args[0])
                raise unexpected_arguments(kind.__name__, unknown, known, f"help({listed})", kind.names_within())
            try:
                given = signature.bind_partial(*args, **kwargs).arguments
            except TypeError as error:
                raise TypeError(f"{type(args[0]).__name__}: {error}") from None
            preset = find_preset(presets, given.get("preset", signature.parameters["preset"].default))
            for name, value in preset.items():
                if left_alone is not None and left_alone(name, given):
                    continue
                if name in MERGED:
                    check_dict(name, given.get(name))
                    kwargs[name] = {**value, **(given.get(name) or {})}
                elif name not in given:
                    kwargs[name] = value
            init(*args, **kwargs)

        return wrapped

    return wrap


def find_preset(presets: Presets, name: str) -> dict[str, Any]:
    """The hyperparameters that preset ``name`` changes.

    :param presets: by name
    :param name: what a user wrote
    :raises ValueError: for an unknown name; the message lists the known ones
    """
    if not is_choice(name, presets):
        raise ValueError(f"Unknown preset {name!r}; known are {sorted(presets)}.{did_you_mean([name], presets)}")
    return presets[name]
