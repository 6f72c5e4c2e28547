"""Learn a task twice, side by side: from scratch, and by an agent that explored the body before, without any reward.

Walker from states, one agent a core. The agent that explored ships with this package; --pretrain-frames trains another one.
"""

from __future__ import annotations

import argparse
from typing import Any

from sb3_dreamer_urlb.command_parser import a_path, a_seed, at_least

HELP = "learn a walker task with and without pre-training, side by side, and show the difference"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """
    :param parser: of this command
    """
    parser.add_argument("--out", type=a_path, help="folder for everything that is written (default: demo_output)")
    parser.add_argument("--task", help="of the walker: flip, run, walk, stand (default: flip)")
    parser.add_argument("--seed", type=a_seed, help="of everything random (default: 0)")
    parser.add_argument("--finetune-frames", type=at_least(1), help="frames that each agent learns from (default: 20000)")
    parser.add_argument(
        "--pretrain-frames",
        type=at_least(1),
        help="pre-train an agent now, for so many frames (40000 made the one that ships)",
    )
    parser.add_argument("--episodes", type=at_least(1), help="evaluation episodes (default: 10)")


def run(options: dict[str, Any]) -> int:
    """
    :param options: of the command line
    :return: exit status
    :raises ValueError: for an unknown task, or a number that is not positive
    :raises ImportError: if the extra ``plots`` is not installed
    """
    from sb3_dreamer_urlb.cli.side_by_side import DemoConfig, run_demo

    run_demo(DemoConfig(**options))
    return 0
