"""What counts as a number in arguments: numpy's too, booleans never."""

from __future__ import annotations

import math
from collections.abc import Container, Sequence
from numbers import Integral, Real
from typing import Any

import numpy as np


def plain(value: Any) -> Any:
    """numpy's scalars as Python's numbers and booleans, in dictionaries, lists and tuples, too; all else as it is.

    So are arrays without axes, which some of numpy's functions give where others give scalars.

    Everything that takes arguments takes them through this: torch, Stable-Baselines3 and JSON each refuse some of numpy's.
    """
    if isinstance(value, np.generic) or (isinstance(value, np.ndarray) and value.ndim == 0):
        return value.item()
    if type(value) is dict:
        return {key: plain(item) for key, item in value.items()}
    if type(value) in (list, tuple):
        return type(value)(plain(item) for item in value)
    return value


def is_integer(value: Any) -> bool:
    """Whether ``value`` is a whole number by type."""
    return isinstance(value, Integral) and not isinstance(value, bool)


def is_number(value: Any) -> bool:
    """Whether ``value`` is a real number and not NaN."""
    # By comparison: math.isnan has no answer for integers that no float holds.
    return isinstance(value, Real) and not isinstance(value, bool) and bool(value == value)


def is_finite_number(value: Any) -> bool:
    """Whether ``value`` is a real number, neither NaN nor infinite, also as a float."""
    try:
        return is_number(value) and math.isfinite(value)
    except OverflowError:
        return False


def check_integer(name: str, value: Any, least: int) -> None:
    """
    :param name: of the argument, for the message
    :param value: what was given
    :param least: smallest allowed value
    :raises ValueError: if ``value`` is no integer, or smaller
    """
    if not is_integer(value) or value < least:
        raise ValueError(f"{name} must be an integer of at least {least}, got {value!r}.")


def check_switch(name: str, value: Any) -> None:
    """
    :param name: of the argument, for the message
    :param value: what was given
    :raises ValueError: for anything but True and False
    """
    if not isinstance(value, bool):
        raise ValueError(f"{name} must be True or False, got {value!r}.")


def is_choice(value: Any, choices: Container[str]) -> bool:
    """Whether ``value`` is one of these words, whatever it is: a list has no hash, an array compares number by number."""
    return isinstance(value, str) and value in choices


def check_choice(name: str, value: Any, choices: Sequence[str]) -> None:
    """
    :param name: of the argument, for the message
    :param value: what was given
    :param choices: what it may be
    :raises ValueError: for anything else
    """
    if not is_choice(value, choices):
        raise ValueError(f"{name} must be one of {tuple(choices)}, got {value!r}.")


def check_dict(name: str, value: Any) -> None:
    """
    :param name: of the argument, for the message
    :param value: what was given
    :raises ValueError: if ``value`` is neither a dictionary nor None
    """
    if value is not None and not isinstance(value, dict):
        raise ValueError(f"{name} must be a dictionary or None, got {value!r}.")


def check_positive(owner: Any, *names: str) -> None:
    """
    :param owner: whose attributes to check
    :param names: of the attributes
    :raises ValueError: for one below 1
    """
    for name in names:
        if getattr(owner, name) < 1:
            raise ValueError(f"{name} must be positive, got {getattr(owner, name)}.")
