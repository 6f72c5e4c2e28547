"""What the logs in a run's folder say, by tag: Stable-Baselines3's logger's, or else what Monitor and EvalCallback keep."""

from __future__ import annotations

import csv
import io
import json
import re
import zipfile
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sb3_dreamer_urlb.evaluation.names import counted
from sb3_dreamer_urlb.runs.run_folder import PRETRAINING_LOGS

Series = list[tuple[float, float]]
#: last episodes whose mean Stable-Baselines3 logs, where nobody says how many
WINDOW = 100


@dataclass
class Logs:
    """
    :param series: tag → (agent steps, value)
    :param notes: what could not be read, and why
    """

    series: dict[str, Series] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def read_logs(folder: Path, switch: float | None, window: int) -> Logs:
    """All that a folder has; what the logger wrote comes before what only Monitor or EvalCallback know.

    :param folder: of the run
    :param switch: agent steps at which fine-tuning began, if it did in this run
    :param window: last episodes whose mean is the return
    :raises ValueError: if logs of several runs lie below it
    """
    logs = Logs()
    for path in (each / "progress.csv" for each in _log_folders(folder, "progress.csv")):
        _read_progress(logs, path, str(path.relative_to(folder)))
    folders = _log_folders(folder, "events.out.tfevents.*")
    if not logs.series and folders:
        _read_events(logs, folders)
    logs.series = {tag: _in_order(points) for tag, points in logs.series.items()}
    kept: dict[str, Callable[[], Series]] = {
        "rollout/ep_rew_mean": lambda: _returns(folder, switch, window),
        "eval/mean_reward": lambda: _evaluations(logs, folder / "evaluations.npz"),
    }
    for tag, points in kept.items():
        if tag not in logs.series and (found := points()):
            logs.series[tag] = found
    return logs


def _in_order(points: Series) -> Series:
    """By step, and each step once: what was logged last, for a run that went on has gone through some steps again."""
    return sorted(dict(points).items())


def _log_folders(folder: Path, name: str) -> list[Path]:
    """Folders of one run that hold a log: the run's own, or else the one below, or those that a logger numbers.

    :raises ValueError: where runs lie beside each other
    """
    if any(folder.glob(name)):
        return [folder]
    found = sorted({path.parent for path in folder.rglob(name)}, key=_by_number)
    runs = {path.parent / re.sub(r"_\d+$", "", path.name) for path in found}
    if len(runs) > 1:
        raise ValueError(f"{folder} holds several runs, not one: name one of {', '.join(map(str, found))}.")
    return found


def _by_number(folder: Path) -> tuple[str, int]:
    """A logger's tenth folder comes after its ninth."""
    name, _, number = str(folder).rpartition("_")
    return (name, int(number)) if number.isdecimal() else (str(folder), 0)


def _read_events(logs: Logs, folders: list[Path]) -> None:
    from tensorboard.backend.event_processing.event_accumulator import SCALARS, EventAccumulator

    for folder in folders:
        events = EventAccumulator(str(folder), {SCALARS: 2000})
        events.Reload()
        for tag in events.Tags()["scalars"]:
            points = [(float(event.step), float(event.value)) for event in events.Scalars(tag)]
            logs.series.setdefault(tag, []).extend(points)


def _read_progress(logs: Logs, path: Path, name: str) -> None:
    bad = 0
    with open(path, newline="", encoding="utf-8", errors="replace") as file:
        # A line that holds a null byte ends the reading of a file.
        lines = csv.DictReader(line.replace("\0", "\N{REPLACEMENT CHARACTER}") for line in file)
        for line in lines:
            step = number(line.get("time/total_timesteps"))
            # More fields than columns stand under no name.
            bad += step is None or None in line
            for tag, text in line.items():
                value = number(text)
                if tag and step is not None and value is not None:
                    logs.series.setdefault(tag, []).append((step, value))
        empty = not lines.fieldnames
    if bad or empty:
        what = "it is empty" if empty else f"{counted(bad, 'line')} of it cannot be read"
        logs.notes.append(f"{name} is damaged: {what}.")


def _returns(folder: Path, switch: float | None, window: int) -> Series:
    """Mean return of the last episodes at each one's end, as the logger has it, from the files of Monitor."""
    found: Series = []
    for part in (folder / PRETRAINING_LOGS, folder):
        # The episode that was open when the environment changed is in no file.
        step = switch if part == folder and found and switch is not None else 0.0
        last: deque[float] = deque(maxlen=window)
        for _, length, score in _episodes(part):
            step += length
            last.append(score)
            found.append((step, sum(last) / len(last)))
    return found


def _episodes(folder: Path) -> list[tuple[float, float, float]]:
    """When each ended, its length in agent steps and its return, over all environments and processes of a run."""
    found = []
    for path in folder.glob("*monitor.csv"):
        first, _, rest = path.read_text(encoding="utf-8", errors="replace").replace("\0", "").partition("\n")
        try:
            begin = number(json.loads(first.removeprefix("#"))["t_start"])
        except (ValueError, KeyError, TypeError):
            continue  # it is no file of Monitor's: damaged_files says so
        for line in csv.DictReader(io.StringIO(rest)):
            score, length, seconds = (number(line.get(column)) for column in "rlt")
            if begin is not None and score is not None and length is not None and seconds is not None:
                found.append((begin + seconds, length, score))
    return sorted(found)


def _evaluations(logs: Logs, path: Path) -> Series:
    """Mean returns of EvalCallback's evaluations."""
    if not path.is_file():
        return []
    try:
        with np.load(path, allow_pickle=False) as file:
            steps, results = file["timesteps"], file["results"]
        return [(float(step), float(np.mean(returns))) for step, returns in zip(steps, results, strict=True)]
    except (OSError, ValueError, TypeError, KeyError, EOFError, zipfile.BadZipFile) as error:
        logs.notes.append(f"{path.name} is damaged: {error}.")
        return []


def number(text: Any) -> float | None:
    """What a field of a table says; None if it is no number."""
    try:
        return float(text)
    except (TypeError, ValueError):
        return None
