"""What the commands share that ask how agents see the trajectories of an oracle."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from sb3_dreamer_urlb.cli.agents import add_statistics_argument
from sb3_dreamer_urlb.command_parser import a_path, a_seed, at_least
from sb3_dreamer_urlb.folders import made_folder

if TYPE_CHECKING:
    from sb3_dreamer_urlb.analysis.trajectories import Trajectory


def add_oracle_arguments(parser: argparse.ArgumentParser) -> None:
    """
    :param parser: of a command
    """
    parser.add_argument("--env", required=True, help="id of the task's environment, such as urlb/walker-run-v0")
    parser.add_argument("--env-kwargs", nargs="+", metavar="NAME=VALUE", help="arguments of the environment")
    parser.add_argument("--oracle", type=a_path, help="snapshot of an agent that has learnt the task: it plays")
    parser.add_argument("--trajectories", type=a_path, help="folder of recorded episodes; --oracle writes them there")
    add_statistics_argument(parser)
    add_statistics_argument(parser, "oracle")
    parser.add_argument("--count", type=at_least(1), default=30, help="trajectories (default: %(default)s, the paper's)")
    parser.add_argument("--seed", type=a_seed, default=2000, help="of the first trajectory (default: %(default)s)")
    parser.add_argument("--rows", type=a_path, help="CSV file of evaluations: the number is written beside this agent's")
    parser.add_argument("--device", default="auto", help="(default: %(default)s)")


def check_oracle_options(options: dict[str, Any]) -> None:
    """Everything about the oracle and the destinations that can be told before anything is loaded or played.

    :param options: of the command line
    :raises ValueError: if neither an oracle nor a folder is given, or a file of rows is none
    :raises OSError: if something is not there, or cannot be written
    """
    from sb3_dreamer_urlb.evaluation.append import check_can_append

    if "oracle" not in options and "trajectories" not in options:
        raise ValueError("Give --oracle, a snapshot that plays, or --trajectories, a folder of recorded episodes.")
    if "oracle" in options and "trajectories" in options:
        made_folder("--trajectories", options["trajectories"])
    if "rows" in options:
        if not options["rows"].exists():
            raise FileNotFoundError(f"There is no file {options['rows']} of evaluations: evaluate the fine-tuned agent first.")
        check_can_append(options["rows"])


def trajectories_of(options: dict[str, Any]) -> list[Trajectory]:
    """What the oracle plays, or played.

    :param options: of the command line
    :raises ValueError: if too few episodes are there
    """
    from sb3_dreamer_urlb.analysis.trajectories import load_trajectories, play_trajectories, save_trajectories
    from sb3_dreamer_urlb.cli.agents import load_agent

    if "oracle" not in options:
        return load_trajectories(options["trajectories"], options["count"])
    its = {**options, "snapshot": options["oracle"], "vec_normalize": options.get("oracle_vec_normalize")}
    oracle, env = load_agent(its, min(options["count"], 10))
    try:
        played = play_trajectories(oracle, env, options["count"], options["seed"])
    finally:
        env.close()
    from sb3_dreamer_urlb.evaluation.names import counted

    returns = [float(one.rewards.sum()) for one in played]
    trajectories = counted(len(played), "trajectory", "trajectories")
    print(f"{options['oracle']}: {trajectories}, return {sum(returns) / len(returns):.1f}")
    if "trajectories" in options:
        save_trajectories(played, options["trajectories"])
    return played


def print_values(what: str, values: list[float]) -> float:
    """A line a trajectory, then the mean; returns it.

    :param what: was measured
    :param values: one a trajectory
    """
    from sb3_dreamer_urlb.evaluation.names import counted

    for i, value in enumerate(values):
        print(f"  trajectory {i:3d}: {value:.6g}")
    mean = sum(values) / len(values)
    print(f"{what}: {mean:.6g} (mean of {counted(len(values), 'trajectory', 'trajectories')})")
    return mean
