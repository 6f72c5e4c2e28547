"""What a folder knows of a run: its snapshot, its logs, its evaluations and its films. Changes nothing there."""

from __future__ import annotations

import csv
import math
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from sb3_dreamer_urlb.evaluation.rows import Row, read_rows

#: a snapshot of each of these names is looked for, in this order; then the newest zip
SNAPSHOTS = ("snapshot.zip", "finetuned.zip", "best_model.zip")
#: films whose names begin so
AGENT, OPEN_LOOP = "agent", "open_loop"
#: beyond this a film makes the page too heavy for a phone
MAX_FILM_BYTES = 12 << 20

Series = list[tuple[float, float]]


@dataclass
class RunFacts:
    """A run, as its folder tells it.

    :param folder: of the run
    :param snapshot: of the agent, None if there is none
    :param data: of the snapshot: arguments, counters, phase
    :param system: on which it was saved
    :param series: tag of the log → (agent steps, value)
    :param films: what is shown → GIF
    :param rows: of evaluations
    :param notes: what could not be read, and why
    """

    folder: Path
    snapshot: Path | None = None
    data: dict[str, Any] = field(default_factory=dict)
    system: str = ""
    series: dict[str, Series] = field(default_factory=dict)
    films: dict[str, Path] = field(default_factory=dict)
    rows: list[Row] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @property
    def arguments(self) -> dict[str, Any]:
        """Of the algorithm's constructor."""
        return dict(self.data.get("arguments", {}))

    @property
    def counters(self) -> dict[str, Any]:
        """Steps, frames, updates, faults."""
        return dict(self.data.get("counters", {}))

    @property
    def action_repeat(self) -> int:
        """Environment frames an agent step."""
        return int(self.counters.get("action_repeat", 1))

    @property
    def switch(self) -> float | None:
        """Agent steps at which fine-tuning began; None without both phases in this run."""
        frames = self.counters.get("pretrained_frames", 0)
        if frames:
            return None if self.begins_with_fine_tuning else float(frames / self.action_repeat)
        points = self.series.get("time/phase_frames", [])
        for (_, before), (step, after) in pairwise(points):
            if after < before:
                return step - after / self.action_repeat
        return None

    @property
    def begins_with_fine_tuning(self) -> bool:
        """Whether the pre-training was another run: the steps that this one counts are those of its fine-tuning."""
        counters = self.counters
        before = counters.get("num_timesteps", 0) * self.action_repeat - counters.get("phase_frames", 0)
        pretrained = counters.get("pretrained_frames", 0)
        return bool(pretrained and before < pretrained / 2)

    def warnings(self) -> list[str]:
        """What a reader should know before trusting the run."""
        found = list(self.notes)
        for name, text in (("skipped_updates", "updates were skipped: a loss or gradient was not finite"),
                           ("env_faults", "episodes were ended by the guards of environments")):  # fmt: skip
            if self.counters.get(name, 0):
                found.append(f"{self.counters[name]} {text}.")
        broken = [tag for tag, points in self.series.items() if not all(math.isfinite(value) for _, value in points)]
        if broken:
            found.append(f"Logged values are not finite: {', '.join(broken)}.")
        return found


def read_run(folder: Path, rows: list[Path] | None = None) -> RunFacts:
    """Collect what a folder knows.

    :param folder: a run folder, the demo's, or any with a snapshot or logs in it
    :param rows: files of evaluations beside those in the folder
    :raises FileNotFoundError: if there is no such folder, or nothing of a run in it
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} is no folder of a run.")
    facts = RunFacts(folder)
    _read_snapshot(facts)
    _read_logs(facts)
    for kind in (AGENT, OPEN_LOOP):
        films = sorted(folder.rglob(f"{kind}*.gif"), key=lambda path: path.stat().st_mtime)
        films = [path for path in films if path.stat().st_size <= MAX_FILM_BYTES]
        if films:
            facts.films[kind] = films[-1]
    for path in [*sorted(folder.glob("*.csv")), *(rows or [])]:
        # Stable-Baselines3's: the log, and what Monitor keeps.
        if path.name == "progress.csv" or path.name.endswith("monitor.csv"):
            continue
        try:
            read = read_rows(path, strict=False)
        except ValueError as error:
            facts.notes.append(str(error))
            continue
        facts.rows += read.rows
        facts.notes += read.report().splitlines()
    if facts.snapshot is None and not facts.series:
        raise FileNotFoundError(f"{folder} holds neither a snapshot nor logs of a run.")
    return facts


def _read_snapshot(facts: RunFacts) -> None:
    from sb3_dreamer_urlb.snapshots.archive import SnapshotError, reading

    named = [facts.folder / name for name in SNAPSHOTS]
    others = sorted(facts.folder.glob("*.zip"), key=lambda path: path.stat().st_mtime, reverse=True)
    for path in [*named, *others]:
        if not path.is_file():
            continue
        try:
            with reading(path, "model") as archive:
                facts.snapshot, facts.data, facts.system = path, archive.data, archive.system_info
            return
        except SnapshotError as error:
            facts.notes.append(str(error))


def _read_logs(facts: RunFacts) -> None:
    for path in sorted(facts.folder.rglob("progress.csv")):
        with open(path, newline="", encoding="utf-8", errors="replace") as file:
            for line in csv.DictReader(file):
                step = _number(line.get("time/total_timesteps"))
                for tag, text in line.items():
                    value = _number(text)
                    if tag and step is not None and value is not None:
                        facts.series.setdefault(tag, []).append((step, value))
    folders = sorted({path.parent for path in facts.folder.rglob("events.out.tfevents.*")})
    if facts.series or not folders:
        return
    from tensorboard.backend.event_processing.event_accumulator import SCALARS, EventAccumulator

    for folder in folders:
        events = EventAccumulator(str(folder), {SCALARS: 2000})
        events.Reload()
        for tag in events.Tags()["scalars"]:
            points = [(float(event.step), float(event.value)) for event in events.Scalars(tag)]
            facts.series.setdefault(tag, []).extend(points)
    for points in facts.series.values():
        points.sort()


def _number(text: Any) -> float | None:
    try:
        return float(text)
    except (TypeError, ValueError):
        return None


def thinned(points: Series, most: int = 400) -> Series:
    """A line with no more points than a picture shows."""
    if len(points) <= most:
        return points
    return [points[i] for i in np.linspace(0, len(points) - 1, most).round().astype(int)]
