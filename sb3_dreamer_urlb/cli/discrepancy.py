"""Latent dynamics discrepancy of a fine-tuning whose decoder was frozen, along an oracle's trajectories."""

from __future__ import annotations

import argparse
from typing import Any

from sb3_dreamer_urlb.cli.oracle import add_oracle_arguments, check_oracle_options, print_values, trajectories_of
from sb3_dreamer_urlb.command_parser import a_path

HELP = "how much fine-tuning changed the model's predictions, along an oracle's trajectories"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """
    :param parser: of this command
    """
    parser.add_argument("pretrained", type=a_path, help="snapshot before the fine-tuning")
    parser.add_argument("finetuned", type=a_path, help="snapshot after it, its decoder frozen")
    add_oracle_arguments(parser)


def run(options: dict[str, Any]) -> int:
    """
    :param options: of the command line
    :return: exit status
    :raises ValueError: for models that cannot be compared, or too few trajectories
    :raises FileNotFoundError: if there is no such snapshot, folder or file
    """
    from sb3_dreamer_urlb.analysis.annotate import DISCREPANCY, about, annotate, check_has_rows
    from sb3_dreamer_urlb.analysis.discrepancy import check_comparable, latent_dynamics_discrepancy
    from sb3_dreamer_urlb.cli.agents import load_agent
    from sb3_dreamer_urlb.evaluation.names import counted

    check_oracle_options(options)
    pretrained, other = load_agent({**options, "snapshot": options["pretrained"]}, 1)
    other.close()
    finetuned, env = load_agent({**options, "snapshot": options["finetuned"]}, 1)
    try:
        check_comparable(pretrained, finetuned)
        matches = about(finetuned, env, tuned=False)
        if "rows" in options:
            check_has_rows(options["rows"], matches)
        values = latent_dynamics_discrepancy(pretrained, finetuned, trajectories_of(options), options["seed"])
        mean = print_values("Latent dynamics discrepancy, nats a categorical", values)
        if "rows" in options:
            count = annotate(options["rows"], matches, DISCREPANCY, mean)
            print(f"  column {DISCREPANCY} of {counted(count, 'row')} of {options['rows']}")
    finally:
        env.close()
    return 0
