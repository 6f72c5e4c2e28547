"""Measure whether fine-tuning should keep the pre-trained actor: it and a fresh one play a few episodes of the task."""

from __future__ import annotations

import argparse
from typing import Any

from sb3_dreamer_urlb.cli.agents import add_statistics_argument
from sb3_dreamer_urlb.command_parser import a_path, a_seed, at_least

HELP = "measure whether fine-tuning should keep the pre-trained actor"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """
    :param parser: of this command
    """
    parser.add_argument("snapshot", type=a_path, help="pre-trained")
    parser.add_argument("--env", required=True, help="id of the task's environment, such as urlb/walker-run-v0")
    parser.add_argument("--env-kwargs", nargs="+", metavar="NAME=VALUE", help="arguments of the environment")
    parser.add_argument("--episodes", type=at_least(1), default=5, help="with each actor (default: %(default)s)")
    parser.add_argument("--seed", type=a_seed, default=3000, help="of the first episode (default: %(default)s)")
    add_statistics_argument(parser)
    parser.add_argument("--device", default="auto", help="(default: %(default)s)")


def run(options: dict[str, Any]) -> int:
    """
    :param options: of the command line
    :return: exit status
    :raises ValueError: for a snapshot without an actor to keep
    :raises FileNotFoundError: if there is no snapshot
    """
    import numpy as np

    from sb3_dreamer_urlb.analysis.actor_trial import try_actor
    from sb3_dreamer_urlb.cli.agents import load_agent
    from sb3_dreamer_urlb.evaluation.names import counted
    from sb3_dreamer_urlb.transfer_rule import keeps_actor

    model, env = load_agent(options, min(options["episodes"], 10))
    try:
        trial = try_actor(model, env, options["episodes"], options["seed"])
    finally:
        env.close()
    for name, returns in (("pre-trained", trial.pretrained), ("fresh", trial.fresh)):
        print(f"  {name} actor: return {np.mean(returns):.1f} ± {np.std(returns):.1f} ({counted(len(returns), 'episode')})")
    rule = "keep" if keeps_actor(model.domain) else "drop"
    print(f"{'keep' if trial.keep else 'drop'} the actor, after {trial.frames} frames; the paper's rule by domains: {rule}")
    return 0
