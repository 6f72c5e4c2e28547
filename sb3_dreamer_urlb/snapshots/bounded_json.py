"""JSON from strangers: no duplicate keys, no NaN, bounded in depth, length and digits."""

from __future__ import annotations

import json
import math
from typing import Any

MAX_DEPTH = 16
MAX_VALUES = 200_000
MAX_TEXT = 65_536
# The longest integers of ours are the 128 bits of a numpy generator.
MAX_DIGITS = 64


def parse(content: bytes) -> Any:
    """Read JSON.

    :param content: UTF-8; its own length is the caller's to bound
    :raises ValueError: saying which bound it breaks
    """
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError:
        raise ValueError("it is no text, where JSON was expected") from None
    try:
        value = json.loads(
            text,
            object_pairs_hook=_unique,
            parse_constant=_no_constant,
            parse_float=_finite,
            parse_int=_short,
        )
    except RecursionError:
        raise ValueError("its JSON is nested too deeply") from None
    _check_bounds(value)
    return value


def dump(value: Any) -> bytes:
    """Write JSON that :func:`parse` reads.

    :raises ValueError: for NaN and infinities
    """
    return json.dumps(value, allow_nan=False, ensure_ascii=True, indent=1).encode()


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) != len(pairs):
        raise ValueError("its JSON has the same key twice in one object")
    return found


def _no_constant(name: str) -> Any:
    raise ValueError(f"its JSON holds {name}")


def _finite(digits: str) -> float:
    value = float(digits)
    if not math.isfinite(value):
        raise ValueError("its JSON holds a number that is too large")
    return value


def _short(digits: str) -> int:
    if len(digits) > MAX_DIGITS:
        raise ValueError(f"its JSON holds an integer of {len(digits)} digits")
    return int(digits)


def _check_bounds(value: Any) -> None:
    count, level = 0, [value]
    for _ in range(MAX_DEPTH):
        following: list[Any] = []
        for item in level:
            if isinstance(item, str):
                _check_text(item)
            elif isinstance(item, dict):
                for key in item:
                    _check_text(key)
                following.extend(item.values())
            elif isinstance(item, list):
                following.extend(item)
        count += len(level)
        if count > MAX_VALUES:
            raise ValueError(f"its JSON holds more than {MAX_VALUES} values")
        if not following:
            return
        level = following
    raise ValueError(f"its JSON is nested more than {MAX_DEPTH} deep")


def _check_text(text: str) -> None:
    if len(text) > MAX_TEXT:
        raise ValueError(f"its JSON holds a text of {len(text)} characters")
    if any("\ud800" <= character <= "\udfff" for character in text):
        raise ValueError("its JSON holds half a character")
