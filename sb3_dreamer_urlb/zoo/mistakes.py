"""What a user of rl_zoo3's commands got wrong costs a line and exit status 2; whatever else goes wrong keeps its traceback."""

from __future__ import annotations

import argparse
import functools
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn
from unittest import mock

import yaml
from stable_baselines3.common import utils
from stable_baselines3.common.logger import Logger

from sb3_dreamer_urlb.algorithm import PhasedAlgorithm
from sb3_dreamer_urlb.command_parser import with_near_choices
from sb3_dreamer_urlb.mistakes import is_a_mistake, tell

#: what Python says of arguments that a function does not have, or lacks
SIGNATURE = ("got an unexpected keyword argument", "missing 1 required", "required positional argument")
#: options of rl_zoo3's that count or seed something → the least they may be; but for their defaults, which say: not given
LEAST = {"n_envs": 1, "n_eval_envs": 1, "eval_episodes": 1, "n_jobs": 1, "n_timesteps": 1, "num_threads": 1, "seed": 0}
#: folders that this process has made for a run, each with those around it that it has made, too, from within
NEW_FOLDERS: list[list[Path]] = []


@contextmanager
def told_in_a_line(prog: str) -> Iterator[None]:
    """Mistakes in options, configurations and environments end the program with a line, as long as no agent has acted.

    The folders that were made for a run which does not begin go with it: ``enjoy`` would take one for the newest run.
    They go, too, where another error ends it then. Once a run collects or a trained agent plays, whatever is raised is not
    about arguments, and goes on upwards.

    :param prog: name of the command
    :raises SystemExit: 2, in place of such an error
    """
    begun: list[bool] = []
    NEW_FOLDERS.clear()
    acts = [
        mock.patch.object(PhasedAlgorithm, name, _noted(getattr(PhasedAlgorithm, name), begun))
        for name in ("collect_rollouts", "predict")
    ]
    logs = mock.patch("stable_baselines3.common.utils.configure_logger", _noting_its_folder(utils.configure_logger))
    with acts[0], acts[1], logs:
        try:
            yield
        except Exception as error:
            if begun:
                raise
            for folder, *around in NEW_FOLDERS:
                _take_back(folder, around)
            if not (is_a_mistake(error) or _is_of_a_configuration(error)):
                raise
            tell(prog, error)
            raise SystemExit(2) from error


def missing(folder: Path) -> list[Path]:
    """What would be made with a folder: it and those around it that are not there, from within."""
    return [path for path in (folder, *folder.parents) if not path.exists()]


def _take_back(folder: Path, around: list[Path]) -> None:
    """
    :param folder: goes with all that is in it
    :param around: go where nobody else has put anything into them
    """
    shutil.rmtree(folder, ignore_errors=True)
    for path in around:
        with suppress(OSError):
            path.rmdir()


def _noting_its_folder(configure: Callable[..., Logger]) -> Callable[..., Logger]:
    @functools.wraps(configure)
    def configure_logger(verbose: int = 0, tensorboard_log: str | None = None, *args: Any, **kwargs: Any) -> Logger:
        if tensorboard_log is None:
            return configure(verbose, tensorboard_log, *args, **kwargs)
        around, before = missing(Path(tensorboard_log)), set(Path(tensorboard_log).glob("*"))
        logger = configure(verbose, tensorboard_log, *args, **kwargs)
        folder = Path(str(logger.get_dir()))
        # A run that goes on writes where it wrote.
        if folder not in before:
            NEW_FOLDERS.append([folder, *around])
        return logger

    return configure_logger


def _noted(original: Callable[..., Any], calls: list[bool]) -> Callable[..., Any]:
    @functools.wraps(original)
    def noted(*args: Any, **kwargs: Any) -> Any:
        calls[:] = [True]
        return original(*args, **kwargs)

    return noted


def _is_of_a_configuration(error: Exception) -> bool:
    if isinstance(error, AttributeError):  # a class named there that its module does not have
        return isinstance(error.obj, ModuleType)
    if isinstance(error, AssertionError):  # as rl_zoo3 checks a few of its options
        return bool(str(error))
    by_python = isinstance(error, TypeError) and any(phrase in str(error) for phrase in SIGNATURE)
    return by_python or isinstance(error, yaml.YAMLError)


def with_values_named(parse: Callable[..., argparse.Namespace]) -> Callable[..., argparse.Namespace]:
    """``ArgumentParser.parse_args``; rl_zoo3 evaluates the values of some options as Python, and whatever that raises is told.

    :param parse: the original
    """

    @functools.wraps(parse)
    def parse_args(parser: argparse.ArgumentParser, *args: Any, **kwargs: Any) -> argparse.Namespace:
        try:
            options = parse(parser, *args, **kwargs)
        except Exception as error:
            parser.error(
                f"{type(error).__name__}: {error}. Values of -params and of environments' arguments are Python, in which text "
                "has quotation marks: \"preset:'tiny'\""
            )
        for name in LEAST.keys() & vars(options).keys():
            number = getattr(options, name)
            if number < LEAST[name] and number != parser.get_default(name):
                option = next("/".join(action.option_strings) for action in parser._actions if action.dest == name)
                parser.error(f"{option} must be at least {LEAST[name]}, got {number}.")
        return options

    return parse_args


def error_in_a_line(parser: argparse.ArgumentParser, message: str) -> NoReturn:
    """``ArgumentParser.error`` without the usage before it: rl_zoo3 has so many options that it would hide what is wrong.

    :param parser: whose options were wrong
    :param message: what was wrong
    :raises SystemExit: 2
    """
    parser.exit(2, f"{parser.prog}: error: {with_near_choices(message)} ({parser.prog} --help lists the options)\n")
