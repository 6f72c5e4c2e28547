"""What counts as a number in arguments: numpy's too, booleans never."""

from __future__ import annotations

import math
from numbers import Integral, Real
from typing import Any


def is_integer(value: Any) -> bool:
    """Whether ``value`` is a whole number by type."""
    return isinstance(value, Integral) and not isinstance(value, bool)


def is_number(value: Any) -> bool:
    """Whether ``value`` is a real number and not NaN."""
    return isinstance(value, Real) and not isinstance(value, bool) and not math.isnan(value)


def is_finite_number(value: Any) -> bool:
    """Whether ``value`` is a real number, neither NaN nor infinite."""
    return is_number(value) and math.isfinite(value)
