"""What shapes all rows of a study, kept in its folder: runs of other settings would stand beside them as if alike."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from sb3_dreamer_urlb.evaluation.rows import read_rows
from sb3_dreamer_urlb.folders import made_folder
from sb3_dreamer_urlb.snapshots.atomic import written_atomically

#: in the folder of a study
FILE = "study.json"
#: value of ``observation`` where agents see pictures; rows leave it out
PIXELS = "pixels"
SEEN = (PIXELS, "state")


def check_same(folder: Path, settings: dict[str, Any]) -> None:
    """
    :param folder: of a study, there or not
    :param settings: of the runs that are to be listed or done there
    :raises ValueError: if the folder holds runs of other settings, or is none; with the way out
    """
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"{folder} is a file: a study needs a folder.")
    own = _plain(settings)
    known = _known(folder, own)
    for name in sorted({*known, *own} if (folder / FILE).exists() else known.keys() & own.keys()):
        if known.get(name) != own.get(name):
            raise ValueError(
                f"{folder} holds runs with {name}={known.get(name)!r}, and {name}={own.get(name)!r} is asked for: give the "
                f"settings of the folder (--{name.replace('_', '-')} {known.get(name)}), or another --folder."
            )


def remember(folder: Path, settings: dict[str, Any]) -> None:
    """
    :param folder: of a study, made if it is not there
    :param settings: of its runs
    """
    made_folder("folder", folder)
    if not (folder / FILE).exists():
        with written_atomically(folder / FILE) as file:
            file.write((json.dumps(_plain(settings), indent=1, sort_keys=True) + "\n").encode())


def _known(folder: Path, own: dict[str, Any]) -> dict[str, Any]:
    path, rows = folder / FILE, folder / "rows.csv"
    if path.exists():
        try:
            known = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise ValueError(f"{path} is damaged ({error}): it says how the folder's runs were made.") from error
        if not isinstance(known, dict):
            raise ValueError(f"{path} is damaged: it holds no settings.")
        return known
    # A folder from before there was such a file: what its rows say.
    first = next(iter(read_rows(rows, strict=False).rows), None) if rows.exists() else None
    if first is None:
        return {}
    said: dict[str, Any] = {"preset": first.preset, "episodes": first.episodes}
    # Of environments of somebody's own a row says nothing.
    return {**said, "observation": first["observation"] or PIXELS} if own["observation"] in SEEN else said


def _plain(settings: dict[str, Any]) -> dict[str, Any]:
    plain: dict[str, Any] = json.loads(json.dumps(settings, default=repr))
    return plain
