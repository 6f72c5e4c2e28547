"""Which rows make a sequence: by episodes as the paper draws them, or by rows for tasks that terminate."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from sb3_dreamer_urlb.number_checks import check_choice

#: from what a sequence's start is drawn
BY_EPISODE, BY_ROW = SAMPLINGS = ("episodes", "rows")
#: of a sequence: number of an episode, first row, row after the last
Pieces = list[tuple[int, int, int]]


def check_sampling(sampling: str) -> None:
    """:raises ValueError: for an unknown name"""
    check_choice("sampling", sampling, SAMPLINGS)


def draw(sampling: str, rng: np.random.Generator, episodes: Sequence[Any], length: int, n: int) -> Iterator[Pieces]:
    """Where the rows of n sequences lie.

    :param sampling: one of ``SAMPLINGS``
    :param rng: source of randomness
    :param episodes: finished ones, oldest first
    :param length: T, rows a sequence
    :param n: number of sequences
    """
    return (_by_episode if sampling == BY_EPISODE else _by_row)(rng, episodes, length, n)


def _by_episode(rng: np.random.Generator, episodes: Sequence[Any], length: int, n: int) -> Iterator[Pieces]:
    """An episode uniformly, then a start uniformly (docs/algorithm.md, "Replay"); none may be shorter than a sequence."""
    for index in rng.integers(len(episodes), size=n):
        start = int(rng.integers(len(episodes[index]) - length + 1))
        yield [(int(index), start, start + length)]


def _by_row(rng: np.random.Generator, episodes: Sequence[Any], length: int, n: int) -> Iterator[Pieces]:
    """A row uniformly, then what follows it; the oldest episode follows the newest, so every row comes equally often."""
    lengths = episode_lengths(episodes)
    ends = lengths.cumsum()
    rows = rng.integers(ends[-1], size=n)
    for row, first in zip(rows, np.searchsorted(ends, rows, side="right"), strict=True):
        index, start, missing = int(first), int(row - ends[first] + lengths[first]), length
        pieces = []
        while missing > 0:
            stop = min(start + missing, int(lengths[index]))
            pieces.append((index, start, stop))
            missing -= stop - start
            index, start = (index + 1) % len(lengths), 0
        yield pieces


def episode_lengths(episodes: Sequence[Any]) -> np.ndarray:
    """Rows of each episode, int64; a store on disk knows them."""
    return np.array(getattr(episodes, "lengths", None) or [len(episode) for episode in episodes])
