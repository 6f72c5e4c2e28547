"""``python -m sb3_dreamer_urlb.zoo train|enjoy|...``: rl_zoo3's commands with ``--algo dreamerv2`` and ``--algo drq_v2``."""

from __future__ import annotations

import argparse
import os
import runpy
import shlex
import sys
from collections.abc import Sequence
from unittest import mock

from sb3_dreamer_urlb.command_parser import CommandParser
from sb3_dreamer_urlb.mistakes import is_a_mistake, tell
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
    parser = CommandParser(
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

        from sb3_dreamer_urlb.zoo import plotting
        from sb3_dreamer_urlb.zoo.found_runs import that_says_what_there_is
        from sb3_dreamer_urlb.zoo.mistakes import error_in_a_line, told_in_a_line, with_values_named
        from sb3_dreamer_urlb.zoo.playing import Played
        from sb3_dreamer_urlb.zoo.registration import register
        from sb3_dreamer_urlb.zoo.resuming import with_runs
    except ModuleNotFoundError as error:
        print(f"{parser.prog}: {error}; {how_to_install('zoo')}", file=sys.stderr)
        return 2
    assert rl_zoo3.ALGOS
    register()
    if command == "plot":
        return plotting.plot(rest, f"{parser.prog} plot")
    if command.endswith("_hub"):
        return _share(command, rest, f"{parser.prog} {command}")
    if command == "enjoy" and not plotting.has_display() and "--no-render" not in rest and "-h" not in rest:
        print("No display: playing without a window (--no-render); record_video makes a film.")
        rest = [*rest, "--no-render"]
    sys.argv = [f"{parser.prog} {command}", *rest]
    played = Played()
    parse_args = with_runs(with_values_named(argparse.ArgumentParser.parse_args))
    with (
        told_in_a_line(sys.argv[0]),
        mock.patch.object(argparse.ArgumentParser, "parse_args", parse_args),
        mock.patch.object(argparse.ArgumentParser, "error", error_in_a_line),
        # The run keeps it, and its model card shows it: to be pasted into a shell.
        mock.patch.object(sys, "orig_argv", [*map(shlex.quote, sys.orig_argv)]),
        mock.patch("rl_zoo3.utils.get_model_path", that_says_what_there_is(rl_zoo3.utils.get_model_path, sys.argv[0])),
        mock.patch("rl_zoo3.create_test_env", played.counting(rl_zoo3.create_test_env)),
    ):
        runpy.run_module(f"rl_zoo3.{command}", run_name="__main__")
    if command == "enjoy" and (complaint := played.complaint()):
        print(f"{sys.argv[0]}: {complaint}", file=sys.stderr)
    return 0


def _share(command: str, rest: list[str], prog: str) -> int:
    from sb3_dreamer_urlb.zoo import hub

    try:
        print({"push_to_hub": hub.push, "load_from_hub": hub.load}[command](rest, prog))
    except Exception as error:
        if not (is_a_mistake(error) or isinstance(error, AssertionError)):
            raise
        tell(prog, error)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
