"""What older files lack: one step a version, each tested with a file of the older form."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

#: of the files written now; goes up with every change that older code could not read
VERSION = 5


def _from_1(kind: str, data: dict[str, Any]) -> dict[str, Any]:
    """Version 2 added what a run needs to go on: random states, statistics of the last episodes, the run's folder."""
    if kind == "model":
        return {**data, "random": None, "episodes": [], "run": None}
    return data


def _from_2(kind: str, data: dict[str, Any]) -> dict[str, Any]:
    """Version 3 counts the environments' faults, the skipped updates, and the frames of the pre-training behind a model.

    Run folders have VecNormalize's statistics since then.
    """
    if kind == "model" and isinstance(data.get("counters"), dict):
        return {**data, "counters": {**data["counters"], "env_faults": 0, "skipped_updates": 0, "pretrained_frames": 0}}
    return data


def _from_3(kind: str, data: dict[str, Any]) -> dict[str, Any]:
    """Version 4 says what a fine-tuning began with; of older ones nobody knows."""
    return {**data, "kept": None} if kind == "model" else data


def _from_4(kind: str, data: dict[str, Any]) -> dict[str, Any]:
    """Version 5 says which task an agent has learnt; of older ones nobody knows."""
    return {**data, "learnt_task": None} if kind == "model" else data


MIGRATIONS: dict[int, Callable[[str, dict[str, Any]], dict[str, Any]]] = {1: _from_1, 2: _from_2, 3: _from_3, 4: _from_4}


def migrate(kind: str, data: dict[str, Any], version: int) -> dict[str, Any]:
    """Bring ``data`` of an older file to the present form.

    :param kind: of the file
    :param data: its JSON
    :param version: its version, at most ``VERSION``
    """
    for older in range(version, VERSION):
        data = MIGRATIONS[older](kind, data)
    return data
