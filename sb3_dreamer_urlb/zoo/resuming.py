"""Runs of rl_zoo3 that go on: what a run's folder says about it, and which run is meant.

rl_zoo3 gives every run a folder, ``logs/dreamerv2/<env>_<number>``, with its command and configuration in
``<env>/args.yml`` and ``<env>/config.yml``; we keep the run itself in ``checkpoint/`` (docs/reliability.md).
"""

from __future__ import annotations

import argparse
import os
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from sb3_dreamer_urlb.runs.run_folder import CHECKPOINT, SNAPSHOT, RunFolder, steps_done, written_at
from sb3_dreamer_urlb.snapshots.archive import SnapshotError

AUTO = "auto"
#: options that say how a run begins, or something else than to train; not taken from the run that goes on
OTHER = ("trained_agent", "conf_file", "hyperparams", "optimize_hyperparameters", "trial_id", "storage", "study_name", "uuid")
#: what a run keeps, and the option that says it
KEPT = {"seed": "--seed", "env_kwargs": "--env-kwargs"}
#: of a configuration: what a run that goes on may have otherwise, for it is none of the model's hyperparameters
MAY_CHANGE = ("n_timesteps", "callback", "checkpoint", "resume")

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
            before = {} if run is None else _options_of(run, options)
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
        for name, option in KEPT.items():
            if has_checkpoint(run) and getattr(options, name, None) != before.get(name):
                its, given = before.get(name), getattr(options, name)
                parser.error(f"the run in {run} has {option} {its}, a run keeps it: {option} {given} is for another one")
        options.run_folder = str(run)
        # Killed before its first checkpoint, a run begins again as it began.
        options.trained_agent = "" if has_checkpoint(run) else before.get("trained_agent", "")
        return options

    return parse_args


def _options_of(run: Path, given: argparse.Namespace) -> dict[str, Any]:
    """As they were when the run began; those of this command, where its file is damaged and a configuration is named."""
    try:
        return saved(run, "args")
    except ValueError as error:
        if getattr(given, "conf_file", None) is None:
            raise
        warnings.warn(f"{error} The options of this command count.")
        return dict(vars(given))


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
    for run in sorted(runs, key=lambda run: written_at(run / CHECKPOINT), reverse=True):
        try:
            options, done = saved(run, "args"), steps_done(run / CHECKPOINT)
        except (ValueError, SnapshotError) as error:
            warnings.warn(f"{run} is passed over: {error}")
            continue
        same = _without_resume(saved(run, "config")) == _without_resume(config)
        same = same and (seed is None or options.get("seed") == seed) and options.get("trained_agent") == trained_agent
        if same and not is_going(run) and done < steps:
            return run
    return None


def _without_resume(config: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in config.items() if name != "resume"}


def check_same(run: Path, hyperparams: dict[str, Any], changed: dict[str, Any] | None) -> None:
    """Whether another configuration than the run's own says the same about the model.

    :param run: that goes on
    :param hyperparams: of the configuration
    :param changed: what ``-params`` changes, which is meant
    :raises ValueError: naming what differs
    """
    try:
        own = saved(run, "config")
    except ValueError:
        return  # the model is the checkpoint's in any case
    names = {*own, *hyperparams} - {*MAY_CHANGE, *(changed or {})}
    if wrong := sorted(name for name in names if own.get(name) != hyperparams.get(name)):
        its, given = (", ".join(f"{name}={of.get(name)!r}" for name in wrong) for of in (own, hyperparams))
        raise ValueError(
            f"The run in {run} has {its}, this configuration {given}: a run keeps its hyperparameters. Without -conf its own "
            "are read, -params changes one."
        )


def is_going(run: Path) -> bool:
    """Whether a process is at work in it."""
    try:
        with RunFolder(run / CHECKPOINT).locked():
            return False
    except RuntimeError:
        return True
