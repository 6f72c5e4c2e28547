"""rl_zoo3's ``lin_1e-3``, a learning rate that falls in a line to 0 at the end of the run, for every rate of our algorithms.

rl_zoo3 reads it for ``learning_rate`` alone, and as a class of its own that no safe file holds.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from stable_baselines3.common.utils import LinearSchedule

PREFIX = "lin_"


def of_rates(hyperparams: dict[str, Any], known: Iterable[str]) -> dict[str, LinearSchedule]:
    """
    :param hyperparams: as they are written
    :param known: arguments of the algorithm
    :return: the rates that are written so, by name
    :raises ValueError: for a rate in words that mean nothing
    """
    written = {name: hyperparams.get(name) for name in known if name.endswith("learning_rate")}
    return {name: _line(name, value) for name, value in written.items() if isinstance(value, str)}


def _line(name: str, value: str) -> LinearSchedule:
    try:
        if not value.startswith(PREFIX):
            raise ValueError
        return LinearSchedule(float(value.removeprefix(PREFIX)), 0.0, 1.0)
    except ValueError:
        raise ValueError(f"{name} must be a number or '{PREFIX}' and a number, got {value!r}.") from None
