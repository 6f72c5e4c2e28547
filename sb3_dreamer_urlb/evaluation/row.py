"""One evaluation of one agent as a row: its columns, and how they stand in a file."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import Any

from sb3_dreamer_urlb.words import counted, mean_and_spread

#: columns that say how an evaluation came about or what it cost; two rows that differ only here are about the same run
DESCRIBING = frozenset(
    ("algorithm_version", "commit", "device", "evaluation_seed", "intrinsic_reward", "ldd", "machine", "note", "returns")
    + ("run_folder", "snapshot", "source", "versions", "written")
)
#: columns of numbers that were measured beside the return
NUMBERS = ("ldd", "intrinsic_reward")
#: further columns of words in which upper and lower case mean the same
WORDS = ("observation", "perturbation", "variant", "adaptation")
#: further columns that are true, false or empty; ``false`` and empty mean the same
FLAGS = ("known_reward", "synthetic")
TRUE, FALSE = ("true", "1", "yes"), ("false", "0", "no", "none", "")
#: what was measured; ``seconds`` may differ between two evaluations that agree
RESULT = ("return_mean", "return_std", "episodes")
#: last column of files that this package writes: when the row was written. Its form tells whole rows from cut ones.
WRITTEN = "written"
NONE = "none"
#: column of the arguments that make another task of an id; rows of the task as it is registered have none
CHANGED = "environment"
#: column of the task that an agent has learnt, where it was evaluated in another one
LEARNT = "learnt_task"
#: column of how an agent acted, where that was otherwise than in the paper
ACTING = "acting"


@dataclass(frozen=True)
class Row:
    """One evaluation of one agent.

    :param method: intrinsic reward of the pre-training; ``dreamer`` or ``drqv2`` without one
    :param domain: of the task
    :param task: in that domain
    :param seed: of the run
    :param pretrain_frames: environment frames without the task's reward (action repeat included)
    :param finetune_frames: environment frames with it, at the evaluation
    :param keep_actor: whether the pre-trained actor was fine-tuned; None where there was none
    :param keep_critic: likewise
    :param planner: that acted in the evaluation, ``none`` for the actor alone
    :param preset: of the model's size
    :param return_mean: undiscounted return, mean of the episodes
    :param return_std: standard deviation over the episodes; NaN if unknown
    :param episodes: how many
    :param seconds: that the evaluation took; NaN if unknown
    :param further: other columns, such as ``observation``, ``perturbation``, ``variant``, ``arm``, ``algorithm``,
        ``known_reward``, ``adaptation``, ``run_folder``; those in :data:`DESCRIBING` do not distinguish runs, all others do
    """

    method: str
    domain: str
    task: str
    seed: int
    pretrain_frames: int
    finetune_frames: int
    keep_actor: bool | None
    keep_critic: bool | None
    planner: str
    preset: str
    return_mean: float
    return_std: float
    episodes: int
    seconds: float = math.nan
    further: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        # One spelling of each word, so that the same run has the same key whoever wrote it.
        object.__setattr__(self, "planner", (self.planner or NONE).strip().lower())
        object.__setattr__(self, "further", {name: _spelled(name, text) for name, text in self.further.items()})

    def __getitem__(self, column: str) -> Any:
        """Value of any column; ``""`` for a further one that the row does not have."""
        return getattr(self, column) if column in REQUIRED else self.further.get(column, "")

    @cached_property
    def key(self) -> tuple[tuple[str, str], ...]:
        """What tells runs apart: every column but what was measured and how it came about."""
        measured = {*RESULT, "seconds", *DESCRIBING}
        own = {name: text for name, text in texts(self).items() if name not in measured and text != ""}
        return tuple(sorted((name, text) for name, text in own.items() if name not in FLAGS or text != "false"))

    @property
    def is_of_the_benchmark(self) -> bool:
        """Whether an agent's best actions were scored in the task that it learnt, and that task is as it is registered."""
        return not any(self[column] for column in (CHANGED, LEARNT, ACTING))

    def setting(self, *varied: str) -> tuple[tuple[str, str], ...]:
        """The key of what is compared: whoever pairs rows or averages them asks for this, so that nothing is forgotten.

        :param varied: columns in which the compared rows may differ, such as ``seed``
        """
        return tuple(part for part in self.key if part[0] not in varied)

    def agrees(self, other: Row) -> bool:
        """Whether both measured the same, but for the last digits."""
        return all(_same(getattr(self, name), getattr(other, name)) for name in RESULT)

    def __str__(self) -> str:
        own = ", ".join(f"{name}={text}" for name, text in self.key)
        score = mean_and_spread(self.return_mean, self.return_std, self.episodes, "g")
        return f"{own}: return {score} of {counted(self.episodes, 'episode')}"


#: columns that every file has
REQUIRED: tuple[str, ...] = tuple(column.name for column in fields(Row) if column.name != "further")


def texts(row: Row) -> dict[str, str]:
    """A row as it stands in a file, column → text.

    :raises ValueError: naming the column, for what no row can hold
    """
    written = {name: _text(name, getattr(row, name)) for name in REQUIRED}
    clash = set(row.further) & set(REQUIRED)
    if clash:
        raise ValueError(f"further columns must be others than {', '.join(sorted(clash))}")
    for name, value in row.further.items():
        if not re.fullmatch(r"[A-Za-z_][\w.-]*", name):
            raise ValueError(f"column {name!r}: expected a word")
        written[name] = _text(name, value)
    return written


def _spelled(name: str, text: Any) -> Any:
    if name not in (*WORDS, *FLAGS):
        return text
    plain = str(text).strip().lower()
    return "true" if name in FLAGS and plain in TRUE else "false" if name in FLAGS and plain in FALSE[:-1] else plain


def _text(name: str, value: Any) -> str:
    if value is None:
        return NONE if name == "planner" else ""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, float):
        return "" if math.isnan(value) else repr(float(value))
    text = str(value)
    if any(character in text for character in "\r\n\0"):
        raise ValueError(f"{name}={text!r}: a row is one line")
    return text


def _same(one: float, other: float) -> bool:
    return math.isclose(one, other, rel_tol=1e-6, abs_tol=1e-6) or (math.isnan(one) and math.isnan(other))
