"""What a row of the replay holds, by name, wherever it is kept."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, TypeVar

import numpy as np

Rows = TypeVar("Rows")
RawObservation = np.ndarray | dict[str, np.ndarray]
#: column of an observation, or of the part of a Dict observation whose name follows
OBSERVATION = "observation"


#: what rows hold
TASK_REWARDS = "task_rewards"
COLUMNS = (OBSERVATION, "action", "reward", "is_terminal", "skill", TASK_REWARDS)


class NamedRows(ABC):
    """An episode, wherever it is kept, with a name for all rows of each column: ``episode.reward``, …, by name for Dicts."""

    @abstractmethod
    def __len__(self) -> int:
        """Rows."""

    @abstractmethod
    def rows(self, start: int, stop: int) -> dict[str, np.ndarray]:
        """Some rows of every column, by name."""

    def __getattr__(self, name: str) -> Any:
        if name not in COLUMNS:
            raise AttributeError(f"{type(self).__name__!r} has no attribute {name!r}")
        rows = self.rows(0, len(self))
        return observation_of(rows) if name == OBSERVATION else rows[name]


def observation_columns(observation: RawObservation) -> dict[str, np.ndarray]:
    """The columns that an observation fills: one, or one for each part of a Dict observation."""
    if isinstance(observation, dict):
        return {f"{OBSERVATION}/{name}": np.asarray(part) for name, part in observation.items()}
    return {OBSERVATION: np.asarray(observation)}


def observation_of(columns: dict[str, Rows]) -> Rows | dict[str, Rows]:
    """The observation among columns, arrays or tensors; undoes :func:`observation_columns`."""
    if OBSERVATION in columns:
        return columns[OBSERVATION]
    prefix = f"{OBSERVATION}/"
    return {name.removeprefix(prefix): rows for name, rows in columns.items() if name.startswith(prefix)}
