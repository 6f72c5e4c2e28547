"""Files of Stable-Baselines3's Monitor in the folder of a run that goes on: each process has its own, no episode is in two."""

from __future__ import annotations

import csv
import io
import itertools
import json
import warnings
from pathlib import Path

from sb3_dreamer_urlb.runs.run_folder import CHECKPOINT, PRETRAINING_LOGS, written_at
from sb3_dreamer_urlb.snapshots.atomic import written_atomically


def put_monitor_files_aside(run: Path) -> None:
    """Keep Monitor from writing over what it wrote before the run was cut off.

    A process's times count from its start, so that each has a file; whoever reads ``*.monitor.csv`` reads them all. Episodes
    after the checkpoint will be played again: they go into ``<number>.undone_<time>``, and a file that cannot be read into
    ``<number>.damaged_<time>``, which nobody reads.

    :param run: its folder, with a checkpoint
    """
    until = written_at(run / CHECKPOINT)
    for file in sorted([*run.glob("*.monitor.csv"), *(run / PRETRAINING_LOGS).glob("*.monitor.csv")]):
        number = file.name.removesuffix(".monitor.csv")
        text = file.read_text(errors="replace").replace("\0", "")
        header, _, rest = text.partition("\n")
        if not number.isdigit() or not header.startswith("#"):
            continue
        columns, kept, undone = _split(header, rest, until)
        if columns is None:
            aside = _unused(file.parent, f"{number}.damaged_{int(until)}", "")
            file.rename(aside)
            warnings.warn(f"{file} cannot be read: it is {aside.name} from now on, and its episodes are in no curve.")
            continue
        if undone:
            with written_atomically(_unused(file.parent, f"{number}.undone_{int(until)}", "")) as target:
                target.write("".join([f"{header}\n", columns, *undone]).encode())
        with written_atomically(file) as target:
            target.write("".join([f"{header}\n", columns, *kept]).encode())
        file.rename(_unused(file.parent, f"{number}.before_{int(until)}", ".monitor.csv"))


def _split(header: str, rest: str, until: float) -> tuple[str | None, list[str], list[str]]:
    """The line of columns, None where nothing can be read; the lines of episodes that ended until then, and the others.

    :param header: first line of a file, JSON behind a #
    :param rest: the other lines
    :param until: seconds since 1970
    """
    columns, *lines = rest.splitlines(keepends=True) or [""]
    try:
        start = float(json.loads(header[1:])["t_start"])
    except (ValueError, KeyError, TypeError):
        return None, [], []
    if "t" not in (names := next(csv.reader([columns]), [])):
        return columns, [], lines
    kept: list[str] = []
    undone: list[str] = []
    for line in lines:
        values = dict(zip(names, next(csv.reader(io.StringIO(line)), []), strict=False))
        try:
            in_time = len(values) == len(names) and start + float(values["t"]) <= until
        except ValueError:
            in_time = False
        (kept if in_time else undone).append(line)
    return columns, kept, undone


def _unused(folder: Path, name: str, suffix: str) -> Path:
    """Whoever goes on twice from one checkpoint has two files to put aside."""
    names = (f"{name}{again}{suffix}" for again in itertools.chain([""], (f"_{i}" for i in itertools.count(2))))
    return next(folder / free for free in names if not (folder / free).exists())
