"""One tidy CSV row per evaluation: the form in which results are kept, exchanged and turned into tables and figures.

Rows that a program wrote half are told apart from rows about unknown things: the first are named and skipped, the second
refused.
"""

from __future__ import annotations

import csv
import io
import math
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from sb3_dreamer_urlb.evaluation.names import UnknownName, method_name, task_name

#: columns that say how an evaluation came about or what it cost; two rows that differ only here are about the same run
DESCRIBING = frozenset(
    ("algorithm_version", "commit", "device", "evaluation_seed", "intrinsic_reward", "ldd", "machine", "note", "returns")
    + ("run_folder", "snapshot", "source", "versions", "written")
)
#: what was measured; ``seconds`` may differ between two evaluations that agree
RESULT = ("return_mean", "return_std", "episodes")
#: last column of files that this package writes: when the row was written. Its form tells whole rows from cut ones.
WRITTEN = "written"
_WRITTEN_FORM = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ|")
NONE = "none"

_TRUE, _FALSE = ("true", "1", "yes"), ("false", "0", "no")
_FRAMES = re.compile(r"(?P<number>[+-]?\d+(?:\.\d*)?(?:[eE][+]?\d+)?)\s*(?P<scale>[kKmM]?)\s*(?P<unit>[A-Za-z_ ]*)")
_SCALE = {"": 1, "k": 1_000, "m": 1_000_000}


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

    def __getitem__(self, column: str) -> Any:
        """Value of any column; ``""`` for a further one that the row does not have."""
        return getattr(self, column) if column in REQUIRED else self.further.get(column, "")

    @cached_property
    def key(self) -> tuple[tuple[str, str], ...]:
        """What tells runs apart: every column but what was measured and how it came about."""
        measured = {*RESULT, "seconds", *DESCRIBING}
        own = {name: text for name, text in texts(self).items() if name not in measured and text != ""}
        return tuple(sorted(own.items()))

    def agrees(self, other: Row) -> bool:
        """Whether both measured the same, but for the last digits."""
        return all(_same(getattr(self, name), getattr(other, name)) for name in RESULT)

    def __str__(self) -> str:
        own = ", ".join(f"{name}={text}" for name, text in self.key)
        return f"{own}: return {self.return_mean:g} ± {self.return_std:g} of {self.episodes} episodes"


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


def parse(values: dict[str, str], methods: Iterable[str] = (), tasks: Iterable[str] = (), strict: bool = True) -> Row:
    """A row from its texts.

    :param values: column → text in the order of the file, all required columns among them
    :param methods: further methods that are allowed
    :param tasks: further tasks that are allowed, ``<domain>-<task>``
    :param strict: False allows every method and task
    :raises UnknownName: for an unknown method, task or unit of frames
    :raises ValueError: naming the column, for what cannot be read
    """
    domain, task = (values[name].strip().lower() for name in ("domain", "task"))
    further = {name: text for name, text in values.items() if name not in REQUIRED and text != ""}
    unit = further.get("unit", further.get("frames_unit", "frames"))
    if unit.lower() not in ("frame", "frames", "environment frames"):
        raise UnknownName(f"unknown unit {unit!r} of frames; expected environment frames")
    if next(reversed(values)) == WRITTEN and not _WRITTEN_FORM.fullmatch(values[WRITTEN]):
        raise ValueError(f"{WRITTEN}={values[WRITTEN]!r} is cut off")
    row = Row(
        method=values["method"].strip(),
        domain=domain,
        task=task,
        seed=_integer("seed", values["seed"], 0),
        pretrain_frames=frames("pretrain_frames", values["pretrain_frames"]),
        finetune_frames=frames("finetune_frames", values["finetune_frames"]),
        keep_actor=_truth("keep_actor", values["keep_actor"]),
        keep_critic=_truth("keep_critic", values["keep_critic"]),
        planner=values["planner"].strip() or NONE,
        preset=values["preset"].strip(),
        return_mean=_number("return_mean", values["return_mean"]),
        return_std=_number("return_std", values["return_std"], optional=True),
        episodes=_integer("episodes", values["episodes"], 1),
        seconds=_number("seconds", values["seconds"], optional=True),
        further=further,
    )
    # Last: what is cut off may be half a name.
    if strict:
        task_name(domain, task, tasks)
    return replace(row, method=method_name(row.method, methods if strict else [row.method.lower()]))


def frames(name: str, text: str) -> int:
    """A number of environment frames, such as ``2000000``, ``2e6``, ``2M`` or ``100k``.

    :param name: of the column, for the message
    :param text: in the file
    :raises UnknownName: for another unit
    :raises ValueError: for what is no whole number, or negative
    """
    found = _FRAMES.fullmatch(text.strip())
    if found is None:
        raise ValueError(f"{name}={text!r} is no number of frames")
    if found["unit"].strip().lower() not in ("", "frame", "frames"):
        raise UnknownName(f"{name}={text!r}: unknown unit {found['unit'].strip()!r}; expected environment frames")
    number = float(found["number"]) * _SCALE[found["scale"].lower()]
    if number < 0 or not math.isfinite(number) or abs(number - round(number)) > 1e-6:
        raise ValueError(f"{name}={text!r}: expected a whole number of frames, at least 0")
    return round(number)


def _integer(name: str, text: str, least: int) -> int:
    if not re.fullmatch(r"\s*-?\d+(?:\.0*)?\s*", text) or int(float(text)) < least:
        raise ValueError(f"{name}={text!r}: expected a whole number of at least {least}")
    return int(float(text))


def _number(name: str, text: str, optional: bool = False) -> float:
    if optional and text.strip().lower() in ("", "nan"):
        return math.nan
    try:
        number = float(text)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise ValueError(f"{name}={text!r}: expected a finite number")
    return number


def _truth(name: str, text: str) -> bool | None:
    plain = text.strip().lower()
    if plain in ("", NONE):
        return None
    if plain not in _TRUE + _FALSE:
        raise ValueError(f"{name}={text!r}: expected true, false or nothing")
    return plain in _TRUE


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


# -- reading -----------------------------------------------------------------------------------------------------------


@dataclass
class Rows:
    """What a file holds, and what is wrong with it.

    :param rows: one per run, in the order of the file
    :param skipped: lines that cannot be read, each with its number and why
    :param duplicates: rows that are there once more
    :param disagreements: pairs of rows about the same run that measured different things; the later one stands in ``rows``
    """

    rows: list[Row] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    duplicates: int = 0
    disagreements: list[str] = field(default_factory=list)

    def report(self) -> str:
        """What a reader should know before trusting the rows, in lines; empty if all is well."""
        lines = []
        if self.skipped:
            lines += [f"{len(self.skipped)} rows skipped:", *(f"  {reason}" for reason in self.skipped)]
        if self.disagreements:
            lines += [
                f"{len(self.disagreements)} rows disagree with an earlier one about the same run; the later one counts:",
                *(f"  {pair}" for pair in self.disagreements),
            ]
        if self.duplicates:
            lines.append(f"{self.duplicates} rows stand there more than once and count once.")
        return "\n".join(lines)


def read_rows(
    *paths: str | os.PathLike[str], methods: Iterable[str] = (), tasks: Iterable[str] = (), strict: bool = True
) -> Rows:
    """Read evaluations from CSV files.

    A line that cannot be read (cut off, not a number, too many fields) is skipped and named in the result.

    :param paths: of the files; together they count as one
    :param methods: further methods that are allowed
    :param tasks: further tasks that are allowed, ``<domain>-<task>``
    :param strict: False allows every method and task
    :raises FileNotFoundError: naming the file
    :raises UnknownName: for an unknown method, task or unit of frames, naming file and line
    :raises ValueError: if a required column is missing, naming file and columns
    """
    methods, tasks = tuple(methods), tuple(tasks)
    result = Rows()
    by_key: dict[tuple[tuple[str, str], ...], tuple[Row, str]] = {}
    for path in paths:
        lines = lines_of(Path(path).read_bytes(), "replace")
        columns = header(lines[0], path)
        for number, line in enumerate(lines[1:], 2):
            if not line.strip():
                continue
            place = f"{path}, line {number}"
            try:
                row = parse(_cells(columns, line), methods, tasks, strict)
            except UnknownName as error:
                raise UnknownName(f"{place}: {error}") from error
            except ValueError as error:
                result.skipped.append(f"{place}: {error}")
                continue
            _enter(result, by_key, row, place)
    result.rows = [row for row, _ in by_key.values()]
    return result


def _enter(result: Rows, by_key: dict[tuple[tuple[str, str], ...], tuple[Row, str]], row: Row, place: str) -> None:
    known = by_key.get(row.key)
    if known is None:
        by_key[row.key] = (row, place)
    elif known[0].agrees(row):
        result.duplicates += 1
    else:
        result.disagreements.append(
            f"{known[1]} has return {known[0].return_mean:g}, {place} has {row.return_mean:g} for {row}"
        )
        by_key[row.key] = (row, place)


def lines_of(content: bytes, errors: str) -> list[str]:
    """The lines of a file without their ends, at least one.

    :param content: of the file
    :param errors: what becomes of bytes that are no UTF-8, as ``bytes.decode`` takes it
    """
    # Not splitlines, which also splits where a text has a form feed.
    return [line.removesuffix("\r") for line in content.decode("utf-8-sig", errors).split("\n")]


def header(line: str, path: str | os.PathLike[str]) -> list[str]:
    """The columns of a file.

    :param line: its first
    :param path: for the message
    :raises ValueError: if a required column is missing, or one is there twice
    """
    columns = [name.strip() for name in next(csv.reader([line]), [])]
    missing = [name for name in REQUIRED if name not in columns]
    if missing:
        raise ValueError(f"{os.fspath(path)} lacks the columns {', '.join(missing)}; its first line is {line[:120]!r}")
    twice = sorted({name for name in columns if columns.count(name) > 1})
    if twice:
        raise ValueError(f"{os.fspath(path)} has the column {', '.join(twice)} more than once")
    return columns


def _cells(columns: list[str], line: str) -> dict[str, str]:
    if "�" in line or "\0" in line:
        raise ValueError("unreadable characters")
    try:
        cells = next(csv.reader([line], strict=True))
    except csv.Error as error:
        raise ValueError(f"half-written ({error})") from error
    if len(cells) != len(columns):
        raise ValueError(f"half-written: {len(cells)} of {len(columns)} fields")
    return dict(zip(columns, cells, strict=True))


def line_of(cells: Iterable[str]) -> str:
    """Cells as one line of a CSV file, with its end."""
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerow(list(cells))
    return buffer.getvalue()
