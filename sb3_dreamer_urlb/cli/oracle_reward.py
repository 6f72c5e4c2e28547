"""Mean intrinsic reward of a pre-trained snapshot along an oracle's trajectories."""

from __future__ import annotations

import argparse
from typing import Any

from sb3_dreamer_urlb.cli.oracle import add_oracle_arguments, check_oracle_options, print_values, trajectories_of
from sb3_dreamer_urlb.command_parser import a_path

HELP = "how interesting a pre-trained agent finds an oracle's trajectories"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """
    :param parser: of this command
    """
    parser.add_argument("snapshot", type=a_path, help="pre-trained, not fine-tuned")
    add_oracle_arguments(parser)


def run(options: dict[str, Any]) -> int:
    """
    :param options: of the command line
    :return: exit status
    :raises ValueError: for a model without an intrinsic reward, or too few trajectories
    :raises FileNotFoundError: if there is no such snapshot, folder or file
    """
    from sb3_dreamer_urlb.analysis.annotate import FROM_ONE_PRETRAINING, INTRINSIC_REWARD, about, annotate, check_has_rows
    from sb3_dreamer_urlb.analysis.novelty import check_has_intrinsic_reward, intrinsic_reward_on
    from sb3_dreamer_urlb.cli.agents import load_agent
    from sb3_dreamer_urlb.evaluation.names import counted

    check_oracle_options(options)
    model, env = load_agent(options, 1)
    try:
        check_has_intrinsic_reward(model)
        matches = about(model, env, tuned=True)
        if "rows" in options:
            check_has_rows(options["rows"], matches, FROM_ONE_PRETRAINING)
        values = intrinsic_reward_on(model, trajectories_of(options), options["seed"])
        mean = print_values(f"Intrinsic reward of {model.intrinsic_reward}", values)
        if "rows" in options:
            count = annotate(options["rows"], matches, INTRINSIC_REWARD, mean, FROM_ONE_PRETRAINING)
            print(f"  column {INTRINSIC_REWARD} of {counted(count, 'row')} of {options['rows']}")
    finally:
        env.close()
    return 0
