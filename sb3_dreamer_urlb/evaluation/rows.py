"""One tidy CSV row per evaluation: the form in which results are kept, exchanged and turned into tables and figures.

Rows that a program wrote half are told apart from rows about unknown things: the first are named and skipped, the second
refused.
"""

from __future__ import annotations

import csv
import io
import os
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from sb3_dreamer_urlb.evaluation.names import UnknownName, counted
from sb3_dreamer_urlb.evaluation.row import ACTING, CHANGED, DESCRIBING, LEARNT, NONE, REQUIRED, RESULT, WRITTEN, Row, texts
from sb3_dreamer_urlb.evaluation.row_parsing import frames, parse

__all__ = [
    "ACTING",
    "CHANGED",
    "DESCRIBING",
    "LEARNT",
    "NONE",
    "REQUIRED",
    "RESULT",
    "WRITTEN",
    "Row",
    "Rows",
    "frames",
    "header",
    "line_of",
    "lines_of",
    "parse",
    "read_rows",
    "texts",
]


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
            lines += [f"{counted(len(self.skipped), 'row')} skipped:", *(f"  {reason}" for reason in self.skipped)]
        if self.disagreements:
            lines += [
                f"{counted(len(self.disagreements), 'row disagrees', 'rows disagree')} with an earlier one about the same "
                "run; the later one counts:",
                *(f"  {pair}" for pair in self.disagreements),
            ]
        if self.duplicates:
            lines.append(f"{counted(self.duplicates, 'further copy', 'further copies')} of rows: each row counts once.")
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
    return re.split("\r\n|\n|\r", content.decode("utf-8-sig", errors))


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
