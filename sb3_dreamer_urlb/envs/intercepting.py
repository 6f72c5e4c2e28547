"""Letting calls of an object's methods go through a function of ours, whatever its class."""

from __future__ import annotations

import functools
import types
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any


def intercept(owner: Any, names: Sequence[str], around: Callable[..., Any]) -> bool:
    """Let calls of methods go through ``around``, once; objects that take no attributes are left alone.

    What is put into the instance is a method bound to it: in a deep copy it is bound to the copy.

    :param owner: whose methods
    :param names: of them
    :param around: called with the owner, the method and its arguments
    :return: whether any does so only from now on
    """
    new = False
    for name in names:
        mine = getattr(owner, "__dict__", {}).get(name)
        if around in getattr(mine, "interceptors", ()):
            continue
        with suppress(AttributeError, TypeError):
            setattr(owner, name, types.MethodType(_interceptor(owner, name, mine, around), owner))
            new = True
    return new


def _interceptor(owner: Any, name: str, mine: Any, around: Callable[..., Any]) -> Callable[..., Any]:
    on_class = mine is None and hasattr(type(owner), name)
    found: Any = None if on_class else getattr(owner, name)

    def method(self: Any, *args: Any, **kwargs: Any) -> Any:
        original: Callable[..., Any]
        if on_class:
            original = functools.partial(getattr(type(self), name), self)
        elif isinstance(found, types.MethodType) and found.__self__ is owner:
            original = functools.partial(found.__func__, self)
        else:
            original = found
        return around(self, original, *args, **kwargs)

    # A pickle of the bound method looks it up by its name.
    method.__name__ = name
    method.interceptors = (*getattr(mine, "interceptors", ()), around)  # type: ignore[attr-defined]
    return method
