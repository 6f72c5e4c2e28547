"""Lay runs, or groups of seeds, side by side: one page with curves and intervals, and its picture.

A group is a folder of a run, or LABEL=FOLDER,FOLDER,... for several seeds of one setting.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Container, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_dreamer_urlb.command_parser import a_path
from sb3_dreamer_urlb.folders import check_file, made_folder

if TYPE_CHECKING:
    from sb3_dreamer_urlb.evaluation.tables import Table

HELP = "lay runs or groups of seeds side by side, with intervals"
TAGS = ("eval/mean_reward", "rollout/ep_rew_mean")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """
    :param parser: of this command
    """
    parser.add_argument("runs", nargs="+", metavar="RUN", help="folder, or LABEL=FOLDER,FOLDER,... for seeds of one setting")
    parser.add_argument("--out", type=a_path, required=True, help="page, compare.html say; its picture comes beside it")
    parser.add_argument("--tag", help="of the log (default: the first of eval/mean_reward, rollout/ep_rew_mean that all have)")


def run(options: dict[str, Any]) -> int:
    """
    :param options: of the command line
    :return: exit status
    :raises ValueError: for groups that share no log
    :raises FileNotFoundError: if there is no run in a folder
    """
    groups = _groups(options["runs"])
    if options["out"].suffix.lower() in (".png", ".pdf"):
        raise ValueError(f"--out {options['out']} is the page, compare.html say; its picture comes beside it under that name.")
    check_file("--out", options["out"])
    table, written = compare_runs(groups, options["out"], options.get("tag"))
    print(f"{table.text()}\nWrote {', '.join(map(str, written))}.")
    return 0


def _groups(texts: Sequence[str]) -> dict[str, list[Path]]:
    """Label → folders of its runs. A folder alone is a group of its own, called by what tells its path from the others'.

    :param texts: as they were given
    """
    groups: dict[str, list[Path]] = {}
    alone: list[Path] = []
    for text in texts:
        # A folder may be called lr=0.1,seed=2 itself.
        label, equals, folders = ("", "", text) if Path(text).is_dir() else text.rpartition("=")
        if not all(folder.strip() for folder in folders.split(",")) or (equals and not label.strip()):
            raise ValueError(f"{text!r}: expected the folder of a run, or LABEL=FOLDER,FOLDER,...")
        paths = [Path(text)] if Path(text).is_dir() else [Path(folder) for folder in folders.split(",")]
        if not equals and len(paths) > 1:
            raise ValueError(f"{text!r}: several runs are a group, which needs a label: LABEL=FOLDER,FOLDER,...")
        if equals:
            groups.setdefault(label, []).extend(paths)
        else:
            alone += paths
            groups[str(paths[0])] = paths
    whole = [path.resolve().parts for path in alone]
    if twice := sorted({str(path) for path, parts in zip(alone, whole, strict=True) if whole.count(parts) > 1}):
        raise ValueError(f"{', '.join(twice)}: given more than once.")
    given = groups.keys() - {str(path) for path in alone}
    names = {str(path): _telling(parts, whole, given) for path, parts in zip(alone, whole, strict=True)}
    return {names.get(label, label): paths for label, paths in groups.items()}


def _telling(parts: tuple[str, ...], others: Sequence[tuple[str, ...]], labels: Container[str]) -> str:
    """The shortest end of a path that no other one has, and no label."""
    for count in range(1, len(parts) + 1):
        name = str(Path(*parts[-count:]))
        if name not in labels and sum(other[-count:] == parts[-count:] for other in others) == 1:
            return name
    return str(Path(*parts))


def compare_runs(groups: Mapping[str, Sequence[Path]], out: Path, tag: str | None = None) -> tuple[Table, list[Path]]:
    """Write the page and its picture.

    :param groups: label → folders of its runs
    :param out: page
    :param tag: of the log; None takes the first of ``TAGS`` that all runs have
    :return: the table of last values, and the files that were written
    :raises ValueError: for groups that share no log, or a run that stands in a group twice
    :raises FileNotFoundError: if there is no run in a folder
    """
    for label, folders in groups.items():
        there = [folder.resolve() for folder in folders]
        if twice := sorted({str(folder) for folder in there if there.count(folder) > 1}):
            raise ValueError(f"{label!r} has {', '.join(twice)} more than once: a run is one seed of its group.")
    from sb3_dreamer_urlb.evaluation.comparison import compare, mixtures
    from sb3_dreamer_urlb.evaluation.run_facts import read_run
    from sb3_dreamer_urlb.evaluation.run_page import compare_page, embedded_png
    from sb3_dreamer_urlb.snapshots.atomic import written_atomically

    facts = {label: [read_run(folder) for folder in folders] for label, folders in groups.items()}
    for warning in mixtures(facts):
        print(f"These are averaged: {warning}", file=sys.stderr)
    picture, table, settings = compare(facts, tag, TAGS)
    made_folder("the folder of --out", out.parent)
    picture.name = out.stem
    paths = picture.write(out.parent)
    page = compare_page(" against ".join(groups), embedded_png(paths[1]), picture.caption, settings, table)
    with written_atomically(out) as file:
        file.write(page.encode())
    return table, [out, *paths]
