"""``plot``: rl_zoo3's learning curves, also into a file, also with an environment's id as the other commands take it."""

from __future__ import annotations

import argparse
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

from sb3_dreamer_urlb.command_parser import at_least
from sb3_dreamer_urlb.folders import check_file, made_folder
from sb3_dreamer_urlb.words import counted
from sb3_dreamer_urlb.zoo.found_runs import check_there_are_runs
from sb3_dreamer_urlb.zoo.mistakes import told_in_a_line


def has_display() -> bool:
    """Whether a window can be opened."""
    return not sys.platform.startswith("linux") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def plot(arguments: list[str], prog: str) -> int:
    """
    :param arguments: rl_zoo3's, and ``--output``
    :param prog: name of the command
    :return: exit status, 2 if no run has episodes enough for a curve
    """
    own, rest = _understood(arguments, prog)
    if own.output or not has_display():
        os.environ["MPLBACKEND"] = "Agg"
    from matplotlib import pyplot as plt
    from rl_zoo3.plots import plot_train

    sys.argv = [prog, *rest]
    if own.output:

        def save(*args: Any, **kwargs: Any) -> None:
            if plt.gca().lines:
                made_folder("the folder of --output", Path(own.output).parent)
                plt.savefig(own.output)

        plt.show = save
    with told_in_a_line(prog), _counted(sys.modules[plot_train.__module__]) as counts, warnings.catch_warnings():
        warnings.filterwarnings("ignore", "No artists with labels")  # told below, run by run
        plot_train()
    few = {folder: count for folder, count in counts.items() if count < own.episode_window}
    for folder, count in few.items():
        if count == 0:
            print(f"{prog}: {folder} has no episode that ended: there is nothing to draw", file=sys.stderr)
        else:
            enough = f"-w {max(count // 2, 1)} takes the mean over fewer"
            has = f"{folder} has {counted(count, 'episode')}"
            print(f"{prog}: {has}, too few for a mean over {own.episode_window}: {enough}", file=sys.stderr)
    if not counts:
        print(f"{prog}: no run with finished episodes was found", file=sys.stderr)
    return 2 if len(few) == len(counts) else 0


def _understood(arguments: list[str], prog: str) -> tuple[argparse.Namespace, list[str]]:
    """What of the arguments is ours, and what rl_zoo3 is given.

    :raises SystemExit: 2, if there is nothing to draw, or no place to show it
    """
    parser = argparse.ArgumentParser(prog=prog, add_help=False)
    parser.add_argument("--output")
    parser.add_argument("-w", "--episode-window", type=at_least(1), default=100)
    parser.add_argument("-a", "--algo")
    parser.add_argument("-e", "--env", nargs="+")
    parser.add_argument("-f", "--exp-folder")
    own, rest = parser.parse_known_args(arguments)
    rest = [*rest, "--episode-window", str(own.episode_window)]
    # Folders of runs have a dash where the id has a slash.
    envs = [env.replace("/", "-") for env in own.env or ()]
    for option, given in (("--algo", own.algo), ("--exp-folder", own.exp_folder), ("--env", envs)):
        if given:
            rest += [option, *([given] if isinstance(given, str) else given)]
    if own.output:
        try:
            check_file("--output", own.output)
        except OSError as error:
            parser.error(str(error))
    if not {"-h", "--help"} & set(rest):
        if not own.output and not has_display():
            parser.error("no display to show the curves on: write them into a file with --output")
        if own.algo and envs and own.exp_folder:
            check_there_are_runs(envs, own.exp_folder, own.algo, prog)
    return own, rest


@contextmanager
def _counted(module: Any) -> Iterator[dict[str, int]]:
    """How many episodes rl_zoo3 finds in each folder that it reads meanwhile.

    :param module: of its plot
    """
    counts: dict[str, int] = {}
    load_results = module.load_results

    def counting(folder: str) -> Any:
        found = load_results(folder)
        counts[folder] = len(found)
        return found

    with mock.patch.object(module, "load_results", counting):
        yield counts
