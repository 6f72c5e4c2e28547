"""One episode in memory, open or finished."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from sb3_dreamer_urlb.replay.rows import TASK_REWARDS, NamedRows, RawObservation, observation_columns


class Episode(NamedRows):
    """Contiguous rows that grow while the episode is open.

    :param observation: the episode's first observation; a Dict observation takes one column for each part
    :param action_size: A
    :param skill: under which the first action is chosen, (W,)
    :param tasks: K, of how many tasks beside the environment's own the rewards are kept; no column without any
    """

    def __init__(self, observation: RawObservation, action_size: int, skill: np.ndarray, tasks: int = 0):
        capacity = 128
        seen = observation_columns(observation)
        #: rows of each column, the first ``length`` of them filled
        self.columns: dict[str, np.ndarray] = {
            **{name: np.empty((capacity, *value.shape), value.dtype) for name, value in seen.items()},
            "action": np.zeros((capacity, action_size), np.float32),
            "reward": np.zeros(capacity, np.float32),
            "is_terminal": np.zeros(capacity, bool),
            "skill": np.zeros((capacity, len(skill)), np.float32),
            **({TASK_REWARDS: np.zeros((capacity, tasks), np.float32)} if tasks else {}),
        }
        self.length = 0
        self._put({**seen, "skill": skill})

    @classmethod
    def of(cls, columns: dict[str, np.ndarray]) -> Episode:
        """A finished episode of given rows, for example from a file.

        :param columns: rows of each of ``SequenceReplayBuffer.columns``
        """
        episode = cls.__new__(cls)
        episode.columns, episode.length = columns, len(columns["reward"])
        return episode

    def __len__(self) -> int:
        return self.length

    def append(
        self,
        observation: RawObservation,
        action: np.ndarray,
        reward: float,
        is_terminal: bool,
        skill: np.ndarray,
        task_rewards: Sequence[float] = (),
    ) -> None:
        """Add the row that ``action``, chosen under ``skill``, led to; what other tasks paid for it, (K,)."""
        if self.length == len(self.columns["reward"]):
            self._resize(2 * self.length)
        seen = observation_columns(observation)
        paid = {TASK_REWARDS: task_rewards} if TASK_REWARDS in self.columns else {}
        self._put({**seen, "action": action, "reward": reward, "is_terminal": is_terminal, "skill": skill, **paid})

    def rows(self, start: int, stop: int) -> dict[str, np.ndarray]:
        """Some rows of every column, by name; no copies."""
        return {name: part[start:stop] for name, part in self.columns.items()}

    def finish(self) -> Episode:
        """Give unused memory back."""
        self._resize(self.length)
        return self

    def _put(self, row: dict[str, Any]) -> None:
        for name, value in row.items():
            self.columns[name][self.length] = value
        self.length += 1

    def _resize(self, capacity: int) -> None:
        for name, old in self.columns.items():
            new = np.empty((capacity, *old.shape[1:]), old.dtype)
            new[: self.length] = old[: self.length]
            self.columns[name] = new
