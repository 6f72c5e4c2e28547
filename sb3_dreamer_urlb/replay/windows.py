"""Which rows make a step of the replay: some before it, for stacked frames, and some after it, for its n-step return."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from sb3_dreamer_urlb.replay.sampling import Pieces, episode_lengths


def draw_windows(rng: np.random.Generator, episodes: Sequence[Any], before: int, after: int, n: int) -> Iterator[Pieces]:
    """Draw steps, each as likely as any other, and the rows around them.

    A step begins in any row of an episode but the last. Its window never leaves the episode: rows that would lie before the
    first are the first again, rows that would lie after the last the last again, each as a piece of its own.

    :param rng: source of randomness
    :param episodes: finished ones, of two rows at least
    :param before: rows before the one where the step begins
    :param after: rows after it
    :param n: number of steps
    :return: pieces of ``before + 1 + after`` rows for each
    """
    ends = (episode_lengths(episodes) - 1).cumsum()
    steps = rng.integers(ends[-1], size=n)
    for step, index in zip(steps.tolist(), np.searchsorted(ends, steps, side="right").tolist(), strict=True):
        rows = len(episodes[index])
        yield window(index, rows, step - int(ends[index]) + rows - 1, before, after)


def window(index: int, rows: int, row: int, before: int, after: int) -> Pieces:
    """The rows around one.

    :param index: of the episode
    :param rows: it has
    :param row: where the step begins
    :param before: rows before it
    :param after: rows after it
    """
    start, stop = max(row - before, 0), min(row + after + 1, rows)
    first, last = (index, 0, 1), (index, rows - 1, rows)
    return [first] * (before - (row - start)) + [(index, start, stop)] + [last] * (row + after + 1 - stop)
