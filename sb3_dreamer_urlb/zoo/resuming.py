"""Runs of rl_zoo3 that go on: what a run's folder says about it, and which run is meant.

rl_zoo3 gives every run a folder, ``logs/dreamerv2/<env>_<number>``, with its command and configuration in
``<env>/args.yml`` and ``<env>/config.yml``; we keep the run itself in ``checkpoint/`` (docs/reliability.md).
"""

from __future__ import annotations

import argparse
import csv
import io
import itertools
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from sb3_dreamer_urlb.runs.run_folder import CHECKPOINT, PRETRAINING_LOGS, SNAPSHOT, RunFolder, steps_done
from sb3_dreamer_urlb.snapshots.atomic import written_atomically

AUTO = "auto"
#: options that say how a run begins, or something else than to train; not taken from the run that goes on
OTHER = ("trained_agent", "conf_file", "hyperparams", "optimize_hyperparameters", "trial_id", "storage", "study_name", "uuid")

#: YAML as rl_zoo3 dumps it, and no code: its own way of reading would run whatever a file says
_LOADER: Any = type("PlainLoader", (yaml.SafeLoader,), {})
_LOADER.add_constructor(
    "tag:yaml.org,2002:python/object/apply:collections.OrderedDict",
    lambda loader, node: dict(loader.construct_sequence(node, deep=True)[0]),
)
_LOADER.add_constructor(
    "tag:yaml.org,2002:python/tuple", lambda loader, node: tuple(loader.construct_sequence(node, deep=True))
)


def run_at(path: str | os.PathLike[str]) -> Path | None:
    """The folder of the run that ``-i`` names: itself, its checkpoint's, or the snapshot in there; None for other files.

    :param path: what was given
    :raises ValueError: for a folder that is not a run's
    """
    if not os.fspath(path):
        return None
    folder = Path(path)
    if folder.is_file() and (folder.name, folder.parent.name) == (SNAPSHOT, CHECKPOINT):
        folder = folder.parent
    if not folder.is_dir():
        return None
    if folder.name == CHECKPOINT:
        folder = folder.parent
    if len(list(folder.glob("*/args.yml"))) != 1:
        raise ValueError(
            f"{path} is not the folder of a run: expected one as rl_zoo3 makes them, logs/dreamerv2/<env>_<number>, "
            "or the .zip of a snapshot."
        )
    return folder


def has_checkpoint(run: Path) -> bool:
    """Whether the run came as far as its first checkpoint."""
    return (run / CHECKPOINT / SNAPSHOT).is_file()


def saved(run: Path, what: str) -> dict[str, Any]:
    """What rl_zoo3 noted when the run began.

    :param run: its folder
    :param what: ``"args"``, the command's options, or ``"config"``, the configuration
    :raises ValueError: naming the file, if it cannot be read
    """
    [path] = [*run.glob(f"*/{what}.yml")] or [run / f"{what}.yml"]
    try:
        found = yaml.load(path.read_text(), _LOADER)
    except (OSError, yaml.YAMLError) as error:
        raise ValueError(f"{path} cannot be read ({error}): give the command again as it was, with -conf.") from None
    if not isinstance(found, dict):
        raise ValueError(f"{path} cannot be read: give the command again as it was, with -conf.")
    return found


def with_runs(parse: Callable[..., argparse.Namespace]) -> Callable[..., argparse.Namespace]:
    """``ArgumentParser.parse_args`` for rl_zoo3's ``train``: ``-i`` also takes the folder of a run, or ``auto``.

    Options that are not given are those of the run.

    :param parse: the original
    """

    def parse_args(parser: argparse.ArgumentParser, args: Any = None, namespace: Any = None) -> argparse.Namespace:
        options = parse(parser, args, namespace)
        given = getattr(options, "trained_agent", "")
        if given == AUTO:
            options.trained_agent, options.resume = "", AUTO
            return options
        if given and not os.path.exists(given):
            parser.error(f"-i {given}: there is none; expected the .zip of a snapshot, the folder of a run, or 'auto'")
        try:
            run = run_at(given)
            before = {} if run is None else saved(run, "args")
        except ValueError as error:
            parser.error(str(error))
        if run is None:
            return options
        if "algo" not in before:
            models = ", ".join(map(str, sorted(run.glob("*.zip"))))
            parser.error(f"{run} holds a model that was fetched, not a run that can go on: -i {models} begins with it")
        known = vars(options).keys() - {*OTHER}
        parser.set_defaults(**{name: value for name, value in before.items() if name in known})
        options = parse(parser, args, namespace)
        if options.env != before.get("env") or options.algo != before.get("algo"):
            parser.error(f"the run in {run} is --algo {before.get('algo')} --env {before.get('env')}")
        options.run_folder = str(run)
        # Killed before its first checkpoint, a run begins again as it began.
        options.trained_agent = "" if has_checkpoint(run) else before.get("trained_agent", "")
        return options

    return parse_args


def latest_unfinished(
    log_path: str, env_name: str, config: dict[str, Any], steps: int, seed: int | None, trained_agent: str
) -> Path | None:
    """The run that ``resume: auto`` goes on with.

    :param log_path: folder of the runs
    :param env_name: what their names begin with
    :param config: the configuration; a run of another one is another run
    :param steps: agent steps of the whole run
    :param seed: None takes a run of any
    :param trained_agent: what the run began from
    :return: the newest that is neither finished nor still going; None if there is none
    """
    runs = [run for run in Path(log_path).glob(f"{env_name}_*") if has_checkpoint(run) and [*run.glob("*/args.yml")]]
    for run in sorted(runs, key=lambda run: (run / CHECKPOINT / SNAPSHOT).stat().st_mtime, reverse=True):
        options = saved(run, "args")
        same = _without_resume(saved(run, "config")) == _without_resume(config)
        same = same and (seed is None or options.get("seed") == seed) and options.get("trained_agent") == trained_agent
        if same and not is_going(run) and steps_done(run / CHECKPOINT) < steps:
            return run
    return None


def _without_resume(config: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in config.items() if name != "resume"}


def is_going(run: Path) -> bool:
    """Whether a process is at work in it."""
    try:
        with RunFolder(run / CHECKPOINT).locked():
            return False
    except RuntimeError:
        return True


def put_monitor_files_aside(run: Path) -> None:
    """Keep SB3's Monitor from writing over what it wrote before the run was cut off.

    Episodes after the checkpoint go: they will be played again. Each process's episodes get a file of their own, because
    their times count from its start; whoever reads ``*.monitor.csv`` reads them all.

    :param run: its folder, with a checkpoint
    """
    until = (run / CHECKPOINT / SNAPSHOT).stat().st_mtime
    for file in sorted([*run.glob("*.monitor.csv"), *(run / PRETRAINING_LOGS).glob("*.monitor.csv")]):
        number = file.name.removesuffix(".monitor.csv")
        header, _, rest = file.read_text().partition("\n")
        if not number.isdigit() or not header.startswith("#"):
            continue
        start = json.loads(header[1:])["t_start"]
        kept = io.StringIO()
        reader = csv.DictReader(io.StringIO(rest))
        writer = csv.DictWriter(kept, reader.fieldnames or (), lineterminator="\n")
        writer.writeheader()
        writer.writerows(row for row in reader if row["t"] and start + float(row["t"]) <= until)
        with written_atomically(file) as target:
            target.write(f"{header}\n{kept.getvalue()}".encode())
        file.rename(_unused(file.parent, f"{number}.before_{int(until)}"))


def _unused(run: Path, name: str) -> Path:
    """Whoever goes on twice from one checkpoint has two files to put aside."""
    names = (f"{name}{again}.monitor.csv" for again in itertools.chain([""], (f"_{i}" for i in itertools.count(2))))
    return next(run / free for free in names if not (run / free).exists())
