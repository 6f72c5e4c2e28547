"""How much noise the actor explores with, and how it falls."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sb3_dreamer_urlb.number_checks import is_finite_number

#: a standard deviation, or (at first, at last, agent steps in between)
NoiseStd = float | Sequence[float]


def noise_at(noise_std: NoiseStd, step: int) -> float:
    """The standard deviation after so many agent steps of a phase.

    :param noise_std: a number, or (at first, at last, agent steps in between), which falls linearly
    :param step: agent steps of the phase
    """
    if not isinstance(noise_std, Sequence):
        return float(noise_std)
    first, last, steps = noise_std
    return float(first + (last - first) * min(step / steps, 1.0))


def check_noise_std(noise_std: Any) -> None:
    """:raises ValueError: for what is no such number or schedule"""
    if isinstance(noise_std, Sequence) and not isinstance(noise_std, str) and len(noise_std) == 3:
        good = all(_is_std(value) for value in noise_std[:2])
        if good and not (is_finite_number(noise_std[2]) and noise_std[2] >= 1 and noise_std[2] == int(noise_std[2])):
            raise ValueError(f"noise_std must fall within a whole number of agent steps, 1 or more, got {noise_std!r}.")
    else:
        good = _is_std(noise_std)
    if not good:
        raise ValueError(
            f"noise_std must be a non-negative number, or (at first, at last, agent steps in between), got {noise_std!r}."
        )


def _is_std(value: Any) -> bool:
    return is_finite_number(value) and bool(value >= 0)
