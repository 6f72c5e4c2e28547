"""The command line: ``sb3-dreamer-urlb COMMAND``, or ``python -m sb3_dreamer_urlb COMMAND``."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from types import ModuleType
from typing import Any

from sb3_dreamer_urlb.cli.mistakes import ending_in_a_line
from sb3_dreamer_urlb.command_parser import CommandParser, a_path, a_seed, at_least
from sb3_dreamer_urlb.output_reader import ending_with_its_reader
from sb3_dreamer_urlb.version import __version__

#: commands with a module of their own in ``cli``, which has ``HELP``, ``add_arguments(parser)`` and ``run(options)``
MODULES = (
    "compare",
    "demo",
    "discrepancy",
    "evaluate",
    "figures",
    "keep_actor",
    "oracle_reward",
    "report",
    "study",
    "tasks",
    "zero_shot",
)
DESCRIPTION = (
    "Demonstrations, evaluations, pages and tables of DreamerV2 agents. 'sb3-dreamer-urlb COMMAND --help' tells of each."
)


def command_modules() -> dict[str, ModuleType]:
    """Command → its module."""
    return {name.replace("_", "-"): import_module(f"sb3_dreamer_urlb.cli.{name}") for name in MODULES}


def command_line(modules: Mapping[str, ModuleType]) -> tuple[CommandParser, Mapping[str, argparse.ArgumentParser]]:
    """The parser of everything, and that of each command by its name.

    :param modules: of the commands that have one
    """
    parser = CommandParser(prog="sb3-dreamer-urlb", description=DESCRIPTION)
    parser.add_argument("--version", action="version", version=f"sb3_dreamer_urlb {__version__}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND", title="commands")
    for name in sorted({*modules, *OTHERS}):
        if name in modules:
            module = modules[name]
            module.add_arguments(commands.add_parser(name, help=module.HELP, description=module.__doc__))
        else:
            text, add_arguments, _ = OTHERS[name]
            add_arguments(commands.add_parser(name, help=text, description=f"{text[0].upper()}{text[1:]}."))
    return parser, commands.choices


@ending_with_its_reader()
def main(argv: Sequence[str] | None = None) -> int:
    """Parse the command line and run the command.

    :param argv: arguments, those of the process if None
    :return: exit status
    """
    modules = command_modules()
    parser, commands = command_line(modules)
    parsed, unknown = parser.parse_known_args(argv)
    options = {name: value for name, value in vars(parsed).items() if value is not None}
    command = options.pop("command")
    if unknown:
        commands[command].error(f"unrecognized arguments: {' '.join(unknown)}.")

    # Torch's threads wait asleep: spinning costs a factor of ten where another program uses the other core, and saves a
    # tenth where none does. The variable is read when torch is imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    # Heavy imports only inside, so that --help answers at once.
    act = modules[command].run if command in modules else OTHERS[command][2]
    return ending_in_a_line("sb3-dreamer-urlb", lambda: int(act(options)))


def _demo_pixels_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=a_path, help="folder for everything that is written (default: demo_pixels_output)")
    _small_run_arguments(parser)


def _methods_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=a_path, help="folder of the snapshots (default: methods_output)")
    parser.add_argument("--methods", nargs="+", help="which (default: all)")
    parser.add_argument("--jobs", type=at_least(1), help="methods at a time (default: 2)")
    _small_run_arguments(parser)


def _small_run_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--task", help="for example walker-walk (default: walker-stand)")
    parser.add_argument("--seed", type=a_seed)
    parser.add_argument("--pretrain-frames", type=at_least(0))
    parser.add_argument("--finetune-frames", type=at_least(1))
    parser.add_argument("--episodes", type=at_least(1), help="evaluation episodes")
    parser.add_argument("--preset", help="of the model (default: small)")


def _convert_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("old", type=a_path)
    parser.add_argument("new", type=a_path)
    parser.add_argument("--trust", action="store_true", help="yes, whoever made OLD may run code on this machine")


def _demo_pixels(options: dict[str, Any]) -> int:
    from sb3_dreamer_urlb.cli.demo_pixels import DemoConfig, run_demo

    run_demo(DemoConfig(**options))
    return 0


def _methods(options: dict[str, Any]) -> int:
    from sb3_dreamer_urlb.cli.methods_tour import TourConfig, run_tour

    visits = run_tour(TourConfig(**{**options, "methods": tuple(options.get("methods", ()))}))
    return int(any(visit.faults() for visit in visits))


def _convert(options: dict[str, Any]) -> int:
    from sb3_dreamer_urlb.cli.convert import convert

    model = convert(**options)
    print(f"Wrote {options['new']}: {model.phase}, {model.phase_frames} frames.")
    return 0


#: the other commands: what they do, their arguments, and how they run; their modules are heavy to import
OTHERS = {
    "convert": (
        "rewrite a model that Stable-Baselines3 saved with pickles in the safe form",
        _convert_arguments,
        _convert,
    ),
    "demo-pixels": (
        "pre-train and fine-tune a small agent on walker pixels, and show the result",
        _demo_pixels_arguments,
        _demo_pixels,
    ),
    "methods": (
        "pre-train and fine-tune once with every exploration method, and print a table",
        _methods_arguments,
        _methods,
    ),
}


if __name__ == "__main__":
    sys.exit(main())
