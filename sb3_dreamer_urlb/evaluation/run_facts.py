"""What a folder knows of a run: its snapshot, its logs, its evaluations and its films. Changes nothing there."""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from sb3_dreamer_urlb.evaluation.agent_rows import FROM_SCRATCH
from sb3_dreamer_urlb.evaluation.names import counted
from sb3_dreamer_urlb.evaluation.rows import Row, read_rows
from sb3_dreamer_urlb.evaluation.run_logs import WINDOW, Series, number, read_logs
from sb3_dreamer_urlb.number_checks import is_integer
from sb3_dreamer_urlb.runs.run_folder import CHECKPOINT, SNAPSHOT

#: a snapshot of each of these names is looked for, in this order; then the newest zip
SNAPSHOTS = (SNAPSHOT, f"{CHECKPOINT}/{SNAPSHOT}", "finetuned.zip", "best_model.zip")
#: films whose names begin so
AGENT, OPEN_LOOP = "agent", "open_loop"
#: beyond this a film makes the page too heavy for a phone
MAX_FILM_BYTES = 12 << 20


@dataclass
class RunFacts:
    """A run, as its folder tells it.

    :param folder: of the run
    :param snapshot: of the agent, None if there is none
    :param data: of the snapshot: arguments, counters, phase
    :param system: on which it was saved
    :param series: tag of the log → (agent steps, value)
    :param films: what is shown → GIF
    :param rows: of evaluations; of this run where its snapshot says what it is
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
    def action_repeat(self) -> int | None:
        """Environment frames an agent step, by the snapshot or else by the log; None if neither can be read."""
        if "action_repeat" in self.counters:
            return int(self.counters["action_repeat"])
        # Until fine-tuning begins, both count from the same step.
        ratios = [frames / step for step, frames in self.series.get("time/phase_frames", [])[:1] if step > 0]
        return round(ratios[0]) if ratios and ratios[0] >= 1 and ratios[0] == round(ratios[0]) else None

    @property
    def switch(self) -> float | None:
        """Agent steps at which fine-tuning began; None without both phases in this run."""
        frames = self.counters.get("pretrained_frames", 0)
        if frames:
            return None if self.begins_with_fine_tuning else float(frames / (self.action_repeat or 1))
        points = self.series.get("time/phase_frames", [])
        for (_, before), (step, after) in pairwise(points):
            if after < before:
                return step - after / (self.action_repeat or 1)
        return None

    @property
    def command(self) -> str | None:
        """That began the run, if the folder is rl_zoo3's; without the folder of Python."""
        found = sorted(self.folder.glob("*/command.txt"))
        text = found[0].read_text(encoding="utf-8", errors="replace").strip() if len(found) == 1 else ""
        return re.sub(r"^\S*/", "", text) or None

    @property
    def begins_with_fine_tuning(self) -> bool:
        """Whether the pre-training was another run: the steps that this one counts are those of its fine-tuning."""
        counters = self.counters
        before = counters.get("num_timesteps", 0) * (self.action_repeat or 1) - counters.get("phase_frames", 0)
        pretrained = counters.get("pretrained_frames", 0)
        return bool(pretrained and before < pretrained / 2)

    def warnings(self) -> list[str]:
        """What a reader should know before trusting the run."""
        found = list(self.notes)
        if not self.data:
            found.append("No snapshot can be read: what the run was, and whether updates were skipped, is unknown.")
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
    :raises ValueError: if it holds several runs
    """
    if not folder.is_dir():
        raise FileNotFoundError(f"{folder} is no folder of a run.")
    facts = RunFacts(folder)
    _read_snapshot(facts)
    window: Any = facts.arguments.get("stats_window_size")
    logs = read_logs(folder, facts.switch, window if is_integer(window) and window >= 1 else WINDOW)
    facts.series = logs.series
    facts.notes += [*logs.notes, *damaged_files(folder)]
    for kind in (AGENT, OPEN_LOOP):
        films = sorted(folder.rglob(f"{kind}*.gif"), key=lambda path: path.stat().st_mtime)
        films = [path for path in films if path.stat().st_size <= MAX_FILM_BYTES]
        if films:
            facts.films[kind] = films[-1]
    files = {path.resolve(): path for path in [*sorted(folder.glob("*.csv")), *(rows or [])]}
    for path in files.values():
        # Stable-Baselines3's: the log, and what Monitor keeps.
        if path.name == "progress.csv" or path.name.endswith("monitor.csv"):
            continue
        try:
            read = read_rows(path, strict=False)
        except ValueError as error:
            facts.notes.append(str(error))
            continue
        own = [row for row in read.rows if _is_about(row, facts)]
        if len(own) < len(read.rows):
            others = counted(len(read.rows) - len(own), "row is", "rows are")
            facts.notes.append(
                f"{path}: {others} about other runs and left out (another method, domain, seed, size or length)."
            )
        facts.rows += own
        facts.notes += read.report().splitlines()
    if facts.snapshot is None and not facts.series:
        why = f": {' '.join(facts.notes)}" if facts.notes else "."
        raise FileNotFoundError(f"{folder} holds neither a snapshot nor logs of a run that can be read{why}")
    return facts


def _read_snapshot(facts: RunFacts) -> None:
    from sb3_dreamer_urlb.snapshots.archive import SnapshotError, reading

    named = [facts.folder / name for name in SNAPSHOTS]
    others = sorted(facts.folder.glob("*.zip"), key=lambda path: path.stat().st_mtime, reverse=True)
    for path in dict.fromkeys([*named, *others]):
        if not path.is_file():
            continue
        try:
            with reading(path, "model") as archive:
                facts.snapshot, facts.data, facts.system = path, archive.data, archive.system_info
            if path not in named and len(others) > 1:
                facts.notes.append(f"Of {len(others)} models in the folder the newest is shown, {path.name}.")
            return
        except SnapshotError as error:
            facts.notes.append(str(error))


def _is_about(row: Row, facts: RunFacts) -> bool:
    """Whether a row may be about the run, by what its snapshot says; True where there is no snapshot to ask."""
    if not facts.data:
        return True
    arguments, counters = facts.arguments, facts.counters
    reward, frames = arguments.get("intrinsic_reward"), int(counters.get("phase_frames", 0))
    exploring = facts.data.get("phase") == "pretraining"
    pretrained = frames if exploring else int(counters.get("pretrained_frames", 0))
    method = {reward} if isinstance(reward, str) else {row.method} if reward else {*FROM_SCRATCH.values()}
    early = row.finetune_frames == 0 and row.pretrain_frames <= pretrained
    length = early or (row.pretrain_frames == pretrained and row.finetune_frames <= (0 if exploring else frames))
    # Rows and snapshots of others may leave these out.
    pairs = (
        (row.seed, arguments.get("seed")),
        (row.domain, facts.data.get("domain")),
        (row.preset, arguments.get("preset")),
        *((row[f"keep_{part}"], kept) for part, kept in (facts.data.get("kept") or {}).items() if part != "reward"),
    )
    same = all(one == other for one, other in pairs if one not in (None, "") and isinstance(other, str | int))
    return length and row.method in method and same


def damaged_files(folder: Path) -> list[str]:
    """What lies in the folder of a run and cannot be read, a line each.

    :param folder: of the run
    """
    found = []
    for path in sorted(folder.glob("*monitor.csv")):
        first, columns, *lines = [*path.read_text(encoding="utf-8", errors="replace").splitlines(), "", ""]
        if not first.startswith("#{") or not {"r", "l", "t"} <= set(columns.split(",")):
            found.append(f"{path.name} is damaged: it is no log of Stable-Baselines3's Monitor.")
        elif bad := sum(bool(line) and None in map(number, line.split(",")[:3]) for line in lines):
            found.append(f"{path.name} is damaged: {counted(bad, 'line')} of it cannot be read.")
    for path in sorted(folder.glob("*.vec_normalize.json")):
        try:
            if not isinstance(json.loads(path.read_bytes()).get("statistics"), dict):
                raise ValueError("it holds no statistics")
        except (ValueError, AttributeError) as error:
            found.append(f"{path.name} is damaged: {error}.")
    return found


def thinned(points: Series, most: int = 400) -> Series:
    """A line with no more points than a picture shows."""
    if len(points) <= most:
        return points
    return [points[i] for i in np.linspace(0, len(points) - 1, most).round().astype(int)]
