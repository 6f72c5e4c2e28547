"""``python -m sb3_dreamer_urlb.zoo train|enjoy|...``: rl_zoo3's commands with ``--algo dreamerv2`` and ``--algo drq_v2``."""

from __future__ import annotations

import argparse
import functools
import os
import runpy
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

from sb3_dreamer_urlb.output_reader import ending_with_its_reader
from sb3_dreamer_urlb.version import how_to_install

COMMANDS = {
    "train": "train, go on with a run or from a snapshot (-i), search for hyperparameters (-optimize)",
    "enjoy": "play episodes with a trained model",
    "record_video": "the same, into an .mp4",
    "plot": "draw the learning curves of runs; --output FILE writes the picture",
    "push_to_hub": "put a model on the Hugging Face Hub, or into a folder, with its card",
    "load_from_hub": "fetch a model from there into the folder of runs",
}


@ending_with_its_reader()
def main(argv: Sequence[str] | None = None) -> int:
    """Register our algorithms and hand over to rl_zoo3.

    :param argv: arguments, those of the process if None
    :return: exit status
    """
    parser = argparse.ArgumentParser(
        prog="python -m sb3_dreamer_urlb.zoo",
        description="rl_zoo3 with --algo dreamerv2 or drq_v2.",
        epilog="\n".join(f"{name:14}{text}" for name, text in COMMANDS.items())
        + "\n\nAll else goes to rl_zoo3; '<command> --help' lists it.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("command", choices=COMMANDS)
    arguments = sys.argv[1:] if argv is None else list(argv)
    command, rest = parser.parse_args(arguments[:1]).command, arguments[1:]

    # As in the package's own command line: torch's threads wait asleep. Read when torch is imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    try:
        # Heavy imports only now, so that --help answers at once.
        import rl_zoo3
        import rl_zoo3.utils

        from sb3_dreamer_urlb.zoo.mistakes import told_in_a_line, with_values_named
        from sb3_dreamer_urlb.zoo.playing import Played
        from sb3_dreamer_urlb.zoo.registration import register
        from sb3_dreamer_urlb.zoo.resuming import with_runs
    except ModuleNotFoundError as error:
        print(f"{parser.prog}: {error}; {how_to_install('zoo')}", file=sys.stderr)
        return 2
    assert rl_zoo3.ALGOS
    register()
    if command == "plot":
        return _plot(rest)
    if command.endswith("_hub"):
        return _share(command, rest, f"{parser.prog} {command}")
    if command == "enjoy" and not _has_display() and "--no-render" not in rest and "-h" not in rest:
        print("No display: playing without a window (--no-render); record_video makes a film.")
        rest = [*rest, "--no-render"]
    sys.argv = [f"{parser.prog} {command}", *rest]
    played = Played()
    parse_args = with_runs(with_values_named(argparse.ArgumentParser.parse_args))
    with (
        told_in_a_line(sys.argv[0]),
        mock.patch.object(argparse.ArgumentParser, "parse_args", parse_args),
        mock.patch("rl_zoo3.utils.get_model_path", _that_says_what_there_is(rl_zoo3.utils.get_model_path, sys.argv[0])),
        mock.patch("rl_zoo3.create_test_env", played.counting(rl_zoo3.create_test_env)),
    ):
        runpy.run_module(f"rl_zoo3.{command}", run_name="__main__")
    if command == "enjoy" and (complaint := played.complaint()):
        print(f"{sys.argv[0]}: {complaint}", file=sys.stderr)
    return 0


def _has_display() -> bool:
    return not sys.platform.startswith("linux") or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _share(command: str, rest: list[str], prog: str) -> int:
    from sb3_dreamer_urlb.zoo import hub

    try:
        print({"push_to_hub": hub.push, "load_from_hub": hub.load}[command](rest, prog))
    except (ValueError, ImportError, FileNotFoundError, AssertionError) as error:
        print(f"{prog}: {error}", file=sys.stderr)
        return 2
    return 0


def _that_says_what_there_is(original: Callable[..., Any], prog: str) -> Callable[..., Any]:
    """rl_zoo3's look for a trained model; one that is not there costs a line, with those that are, in place of a traceback."""

    @functools.wraps(original)
    def get_model_path(exp_id: int, folder: str, algo: str, *args: Any, **kwargs: Any) -> Any:
        try:
            return original(exp_id, folder, algo, *args, **kwargs)
        except (AssertionError, ValueError) as error:
            print(f"{prog}: {str(error).rstrip('.')}; {_what_there_is(folder, algo)}", file=sys.stderr)
            raise SystemExit(2) from error

    return get_model_path


def _runs(folder: str, algo: str) -> list[str]:
    return sorted(path.name for path in Path(folder, algo).glob("*") if path.is_dir())


def _what_there_is(folder: str, algo: str) -> str:
    path, runs = Path(folder, algo), _runs(folder, algo)
    return f"runs in {path}: {', '.join(runs)}" if runs else f"no run in {path} (-f names it)"


def _plot(rest: list[str]) -> int:
    """rl_zoo3's learning curves, also into a file, also with an environment's id as the other commands take it.

    :param rest: rl_zoo3's arguments, and ``--output``
    :return: exit status, 2 if no run has episodes enough for a curve
    """
    parser = argparse.ArgumentParser(prog="python -m sb3_dreamer_urlb.zoo plot", add_help=False)
    parser.add_argument("--output")
    parser.add_argument("-w", "--episode-window", type=int, default=100)
    parser.add_argument("-a", "--algo")
    parser.add_argument("-e", "--env", nargs="+")
    parser.add_argument("-f", "--exp-folder")
    own, rest = parser.parse_known_args(rest)
    rest = [*rest, "--episode-window", str(own.episode_window)]
    # Folders of runs have a dash where the id has a slash.
    envs = [env.replace("/", "-") for env in own.env or ()]
    for option, given in (("--algo", own.algo), ("--exp-folder", own.exp_folder), ("--env", envs)):
        if given:
            rest += [option, *([given] if isinstance(given, str) else given)]
    if own.output or not _has_display():
        os.environ["MPLBACKEND"] = "Agg"
    asks_for_help = bool({"-h", "--help"} & set(rest))
    if not own.output and not _has_display() and not asks_for_help:
        parser.error("no display to show the curves on: write them into a file with --output")

    if own.algo and envs and own.exp_folder and not asks_for_help:
        _check_there_are_runs(envs, own.exp_folder, own.algo, parser.prog)

    from matplotlib import pyplot as plt
    from rl_zoo3.plots import plot_train

    from sb3_dreamer_urlb.zoo.mistakes import told_in_a_line

    sys.argv = [parser.prog, *rest]
    if own.output:
        plt.show = lambda *args, **kwargs: plt.savefig(own.output) if plt.gca().lines else None
    counts: dict[str, int] = {}
    module = sys.modules[plot_train.__module__]
    load_results = module.load_results

    def counting(folder: str) -> Any:
        found = load_results(folder)
        counts[folder] = len(found)
        return found

    with told_in_a_line(parser.prog), mock.patch.object(module, "load_results", counting), warnings.catch_warnings():
        warnings.filterwarnings("ignore", "No artists with labels")  # told below, run by run
        plot_train()
    few = {folder: count for folder, count in counts.items() if count < own.episode_window}
    for folder, count in few.items():
        print(
            f"{parser.prog}: {folder} has {count} episodes, too few for a mean over {own.episode_window}: "
            f"-w {max(count // 2, 1)} takes the mean over fewer",
            file=sys.stderr,
        )
    if not counts:
        print(f"{parser.prog}: no run with finished episodes was found", file=sys.stderr)
    return 2 if len(few) == len(counts) else 0


def _check_there_are_runs(envs: list[str], folder: str, algo: str, prog: str) -> None:
    """
    :raises SystemExit: 2, if there is a run of none of the environments; one that has none beside others is named
    """
    runs = _runs(folder, algo)
    missing = [env for env in envs if not any(env in run for run in runs)]
    if missing:
        print(f"{prog}: there is no run of {', '.join(missing)}; {_what_there_is(folder, algo)}", file=sys.stderr)
    if len(missing) == len(envs):
        raise SystemExit(2)


if __name__ == "__main__":
    sys.exit(main())
