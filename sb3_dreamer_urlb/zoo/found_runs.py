"""The runs that lie in rl_zoo3's folder, for messages about one that does not."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any


def what_there_is(folder: str, algo: str) -> str:
    """A sentence's end.

    :param folder: of ``-f``
    :param algo: whose runs
    """
    path, runs = Path(folder, algo), _runs(folder, algo)
    return f"runs in {path}: {', '.join(runs)}" if runs else f"no run in {path} (-f names it)"


def check_there_are_runs(envs: list[str], folder: str, algo: str, prog: str) -> None:
    """One environment that has none beside others is named.

    :param envs: as folders name them
    :param folder: of ``-f``
    :param algo: whose runs
    :param prog: who says it
    :raises SystemExit: 2, if there is a run of none of the environments
    """
    runs = _runs(folder, algo)
    missing = [env for env in envs if not any(env in run for run in runs)]
    if missing:
        print(f"{prog}: there is no run of {', '.join(missing)}; {what_there_is(folder, algo)}", file=sys.stderr)
    if len(missing) == len(envs):
        raise SystemExit(2)


def finding(original: Callable[..., Any]) -> Callable[..., Any]:
    """rl_zoo3's look for a trained model, whose error also says which runs there are.

    :param original: ``rl_zoo3.utils.get_model_path``
    :return: the same; it raises ValueError for a model that is not there
    """

    @functools.wraps(original)
    def get_model_path(exp_id: int, folder: str, algo: str, *args: Any, **kwargs: Any) -> Any:
        try:
            return original(exp_id, folder, algo, *args, **kwargs)
        except (AssertionError, ValueError) as error:
            raise ValueError(f"{str(error).rstrip('.')}; {what_there_is(folder, algo)}") from error

    return get_model_path


def that_says_what_there_is(original: Callable[..., Any], prog: str) -> Callable[..., Any]:
    """rl_zoo3's look for a trained model; one that is not there costs a line, with those that are, in place of a traceback.

    :param original: ``rl_zoo3.utils.get_model_path``
    :param prog: who says it
    """

    found = finding(original)

    @functools.wraps(original)
    def get_model_path(*args: Any, **kwargs: Any) -> Any:
        try:
            return found(*args, **kwargs)
        except ValueError as error:
            print(f"{prog}: {error}", file=sys.stderr)
            raise SystemExit(2) from error

    return get_model_path


def _runs(folder: str, algo: str) -> list[str]:
    return sorted(path.name for path in Path(folder, algo).glob("*") if path.is_dir())
