"""Numbers in sentences and tables for people."""

from __future__ import annotations

import math


def counted(count: int, thing: str) -> str:
    """``1 episode``, ``2 episodes``.

    :param count: how many
    :param thing: one of them
    """
    return f"{count} {thing}{'' if count == 1 else 's'}"


def mean_and_spread(mean: float, std: float, episodes: int, digits: str = ".0f") -> str:
    """``33 ± 4``; of a single episode, or where nobody knows it, without the standard deviation.

    :param mean: return
    :param std: standard deviation, may be NaN
    :param episodes: of how many
    :param digits: a format
    """
    return f"{mean:{digits}}" + ("" if episodes == 1 or math.isnan(std) else f" ± {std:{digits}}")
