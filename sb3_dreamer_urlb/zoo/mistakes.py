"""What a user of rl_zoo3's commands got wrong costs a line and exit status 2; whatever else goes wrong keeps its traceback."""

from __future__ import annotations

import argparse
import functools
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock

import yaml

from sb3_dreamer_urlb.algorithm import PhasedAlgorithm
from sb3_dreamer_urlb.mistakes import is_a_mistake, tell

#: what Python says of arguments that a function does not have, or lacks
SIGNATURE = ("got an unexpected keyword argument", "missing 1 required", "required positional argument")
#: folders of runs that this process has made
NEW_FOLDERS: list[Path] = []


@contextmanager
def told_in_a_line(prog: str) -> Iterator[None]:
    """Mistakes in options, configurations and environments end the program with a line, as long as no agent has acted.

    The folder that was made for a run which does not begin goes with it: ``enjoy`` would take it for the newest run.
    Once a run collects or a trained agent plays, whatever is raised is not about arguments, and goes on upwards.

    :param prog: name of the command
    :raises SystemExit: 2, in place of such an error
    """
    begun: list[bool] = []
    NEW_FOLDERS.clear()
    acts = [
        mock.patch.object(PhasedAlgorithm, name, _noted(getattr(PhasedAlgorithm, name), begun))
        for name in ("collect_rollouts", "predict")
    ]
    with acts[0], acts[1]:
        try:
            yield
        except Exception as error:
            if begun or not (is_a_mistake(error) or _is_of_a_configuration(error)):
                raise
            for folder in NEW_FOLDERS:
                shutil.rmtree(folder, ignore_errors=True)
            tell(prog, error)
            raise SystemExit(2) from error


def _noted(original: Callable[..., Any], calls: list[bool]) -> Callable[..., Any]:
    @functools.wraps(original)
    def noted(*args: Any, **kwargs: Any) -> Any:
        calls[:] = [True]
        return original(*args, **kwargs)

    return noted


def _is_of_a_configuration(error: Exception) -> bool:
    if isinstance(error, AttributeError):  # a class named there that its module does not have
        return isinstance(error.obj, ModuleType)
    by_python = isinstance(error, TypeError) and any(phrase in str(error) for phrase in SIGNATURE)
    return by_python or isinstance(error, yaml.YAMLError)


def with_values_named(parse: Callable[..., argparse.Namespace]) -> Callable[..., argparse.Namespace]:
    """``ArgumentParser.parse_args``; rl_zoo3 evaluates the values of some options as Python, and whatever that raises is told.

    :param parse: the original
    """

    @functools.wraps(parse)
    def parse_args(parser: argparse.ArgumentParser, *args: Any, **kwargs: Any) -> argparse.Namespace:
        try:
            return parse(parser, *args, **kwargs)
        except Exception as error:
            parser.error(
                f"{type(error).__name__}: {error}. Values of -params and of environments' arguments are Python, in which text "
                "has quotation marks: \"preset:'tiny'\""
            )

    return parse_args
