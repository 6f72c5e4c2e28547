"""Adding rows to a file that several processes write: whole rows, each once."""

from __future__ import annotations

import csv
import fcntl
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from sb3_dreamer_urlb.evaluation.rows import REQUIRED, WRITTEN, Row, header, line_of, lines_of, parse, read_rows, texts
from sb3_dreamer_urlb.folders import made_folder
from sb3_dreamer_urlb.snapshots.atomic import written_atomically
from sb3_dreamer_urlb.words import counted


class RowsDisagree(ValueError):
    """Another result of the same run stands in the file already."""


def check_can_append(path: str | os.PathLike[str], rows: Iterable[Row] = ()) -> None:
    """Whether rows can be added to a file, before hours are spent on them. Its folder is made if it is not there.

    :param path: of the CSV file, there or not
    :param rows: that will be added, their results still unknown
    :raises RowsDisagree: if another evaluation of one of them stands there, of other episodes
    :raises ValueError: if it holds no rows
    :raises OSError: if it cannot be written
    """
    path = Path(path)
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder: give a CSV file for the rows.")
    if path.exists() and not path.is_file():
        raise ValueError(f"{path} is no file that rows can be kept in: give a CSV file.")
    made_folder("the folder of the rows", path.parent)
    with _locked(path):
        content = b""
        if path.exists():
            # Not "w": what is there stays.
            with open(path, "ab"):
                content = path.read_bytes()
            if content:
                header(lines_of(content, "replace")[0], path)
        known = {row.key: row for row in read_rows(path, strict=False).rows} if content else {}
    for row in rows:
        there = known.get(row.key, row)
        if any(there[name] != row[name] for name in ("episodes", "evaluation_seed") if there[name] != ""):
            raise _disagreement(path, there, f"{counted(row.episodes, 'episode')} from seed {row['evaluation_seed']} on")


def _disagreement(path: Path, there: Row, now: object) -> RowsDisagree:
    before = f"{there.return_mean:g} of {counted(there.episodes, 'episode')}"
    return RowsDisagree(
        f"{path} holds another result of the same run: {before}, now {now}. "
        "A further column (arm=..., say) tells two runs apart; another file keeps both."
    )


def append_row(path: str | os.PathLike[str], row: Row) -> bool:
    """Add a row to a file, made if it is not there.

    :param path: of the CSV file
    :param row: to add
    :return: False if the row stands there already
    :raises RowsDisagree: if another result of the same run stands there; the file is as it was
    :raises ValueError: for values that no row can hold, or a file that holds no rows
    :raises OSError: if it cannot be written; the file is as it was
    """
    return append_rows(path, [row]) == 1


def append_rows(path: str | os.PathLike[str], rows: Iterable[Row]) -> int:
    """Add rows to a file, all or none.

    A lock keeps other processes out; a column that the file does not have yet is added to all its rows.

    :param path: of the CSV file
    :param rows: to add
    :return: how many were added, the others stand there already
    :raises RowsDisagree: if another result of the same run stands there; the file is as it was
    :raises ValueError: for values that no row can hold, or a file that holds no rows
    :raises OSError: if it cannot be written; the file is as it was
    """
    path = Path(path)
    # To and fro: what cannot be read back is not written.
    rows = [parse(texts(row), strict=False) for row in rows]
    made_folder("the folder of the rows", path.parent)
    with _locked(path):
        # What is there may be about things that a reader would refuse: it is not ours to judge here.
        there = path.exists() and path.stat().st_size > 0
        known = {row.key: row for row in read_rows(path, strict=False).rows} if there else {}
        new: list[dict[str, str]] = []
        for row in rows:
            other = known.setdefault(row.key, row)
            if other is not row and not other.agrees(row):
                raise _disagreement(path, other, row)
            if other is row:
                now = time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
                new.append({**texts(row), WRITTEN: row.further.get(WRITTEN, now)})
        if new:
            _write(path, new)
        return len(new)


def change_rows(path: str | os.PathLike[str], matches: Callable[[Row], bool], columns: Mapping[str, str]) -> int:
    """Write columns of rows that stand in a file; all else stays as it is, what cannot be read included.

    :param path: of the CSV file, which must be there
    :param matches: which rows
    :param columns: further columns and their texts
    :return: how many rows match
    :raises ValueError: for a required column, or a file that holds no rows
    :raises OSError: if it cannot be written; the file is as it was
    """
    path = Path(path)
    if clash := set(columns) & {*REQUIRED, WRITTEN}:
        raise ValueError(f"columns must be others than {', '.join(sorted(clash))}")
    with _locked(path):
        content = path.read_bytes()
        old = header(lines_of(content, "replace")[0], path)
        added = sorted(set(columns) - set(old))
        wide = [*(name for name in old if name != WRITTEN), *added, *([WRITTEN] if WRITTEN in old else [])]
        lines, changed = [], 0
        for line in lines_of(_widened(content, old, wide), "surrogateescape"):
            if not line.strip():
                continue
            found = _row_of(wide, line)
            if found is not None and matches(found[1]):
                line = line_of({**found[0], **columns}[name] for name in wide).rstrip("\n")
                changed += 1
            lines.append(line + "\n")
        if changed:
            with written_atomically(path) as file:
                file.write((line_of(wide) + "".join(lines)).encode("utf-8", "surrogateescape"))
        return changed


def _row_of(columns: list[str], line: str) -> tuple[dict[str, str], Row] | None:
    """The cells of a line and what they say; None for a line that cannot be read."""
    try:
        cells = next(csv.reader([line], strict=True), [])
        values = dict(zip(columns, cells, strict=True))
        return values, parse(values, strict=False)
    except (csv.Error, ValueError):
        return None


@contextmanager
def _locked(path: Path) -> Iterator[None]:
    # A file of its own: the CSV is replaced when columns are added, and a lock would stay with the old one. One lock, whatever
    # links lead to the file.
    path = Path(os.path.realpath(path))
    with open(path.with_name(f".{path.name}.lock"), "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _write(path: Path, new: list[dict[str, str]]) -> None:
    content = path.read_bytes() if path.exists() else b""
    old = header(lines_of(content, "replace")[0], path) if content else []
    added = sorted({name for row in new for name in row} - set(old) - {WRITTEN, *REQUIRED})
    columns = [*(old or REQUIRED), *added]
    if WRITTEN not in old or added:
        columns = [*(name for name in columns if name != WRITTEN), WRITTEN]
    text = "".join(line_of(row.get(name, "") for name in columns) for row in new).encode()
    if columns != old:
        with written_atomically(path) as file:
            file.write(line_of(columns).encode() + _widened(content, old, columns) + text)
        return
    # A line that somebody left without an end stays a line of its own.
    _append(path, text if content.endswith(b"\n") else b"\n" + text)


def _widened(content: bytes, old: list[str], columns: list[str]) -> bytes:
    """The lines of a file under more columns; those that cannot be read stay as they are, and unreadable."""
    lines = []
    for line in lines_of(content, "surrogateescape")[1:]:
        if not line.strip():
            continue
        try:
            cells = next(csv.reader([line], strict=True), [])
        except csv.Error:
            cells = []
        if len(cells) == len(old):
            values = dict(zip(old, cells, strict=True))
            lines.append(line_of(values.get(name, "") for name in columns))
        else:
            # A field too many, where it would look whole among more columns.
            lines.append(line + ("," if len(cells) == len(columns) else "") + "\n")
    return "".join(lines).encode("utf-8", "surrogateescape")


def _append(path: Path, text: bytes) -> None:
    descriptor = os.open(path, os.O_WRONLY | os.O_APPEND)
    size = os.fstat(descriptor).st_size
    try:
        # One write: whoever reads meanwhile sees all of it or nothing.
        if os.write(descriptor, text) != len(text):
            raise OSError(28, "No space left; nothing was added", str(path))
        os.fsync(descriptor)
    except OSError:
        os.ftruncate(descriptor, size)
        raise
    finally:
        os.close(descriptor)
