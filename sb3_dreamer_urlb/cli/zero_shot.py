"""Evaluate a pre-trained snapshot with planning alone (MPPI, known reward), before and, if asked, after fine-tuning."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_dreamer_urlb.cli.agents import (
    add_evaluation_arguments,
    add_statistics_argument,
    environment_of,
    environments_at_a_time,
    load_agent,
)
from sb3_dreamer_urlb.command_parser import a_path, at_least
from sb3_dreamer_urlb.folders import check_file

if TYPE_CHECKING:
    from sb3_dreamer_urlb.dreamer_v2 import DreamerV2

HELP = "plan with a pre-trained model and a known reward, without fine-tuning and with it"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """
    :param parser: of this command
    """
    parser.add_argument("snapshot", type=a_path, help="pre-trained, in the environment of the task or with its reward")
    add_evaluation_arguments(parser)
    parser.add_argument(
        "--planner",
        choices=("mppi_zero_shot", "mppi"),
        default="mppi_zero_shot",
        help="the paper's numbers, or the snapshot's own, for small machines (default: %(default)s)",
    )
    parser.add_argument(
        "--finetune-frames", type=at_least(0), default=0, help="then fine-tune so long, and evaluate again (paper: 100000)"
    )
    parser.add_argument("--freeze-decoder", action="store_true", help="while fine-tuning, for the latent dynamics discrepancy")
    parser.add_argument("--save", type=a_path, help="snapshot of the fine-tuned model")
    parser.add_argument("--rows", type=a_path, help="CSV file that the rows are added to")
    add_statistics_argument(parser)
    parser.add_argument("--device", default="auto", help="(default: %(default)s)")


def run(options: dict[str, Any]) -> int:
    """
    :param options: of the command line
    :return: exit status
    :raises ValueError: for options that do not fit the snapshot or each other
    :raises FileNotFoundError: if there is no snapshot
    """
    from sb3_dreamer_urlb.analysis.zero_shot import check_pretrained, prepare_zero_shot
    from sb3_dreamer_urlb.evaluation.agent_rows import row_of
    from sb3_dreamer_urlb.evaluation.append import append_row, check_can_append
    from sb3_dreamer_urlb.evaluation.episodes import run_evaluation
    from sb3_dreamer_urlb.evaluation.names import counted

    envs = environments_at_a_time(options)
    if options["finetune_frames"] == 0 and (options["freeze_decoder"] or "save" in options):
        raise ValueError("--freeze-decoder and --save need --finetune-frames.")
    if "rows" in options:
        check_can_append(options["rows"])
    if "save" in options:
        check_file("--save", options["save"])
    first, env = load_agent(options, envs)
    env.close()
    check_pretrained(first)
    if "rows" in options and first.seed is None:
        raise ValueError("The model has no seed, and rows tell runs apart by it: load it, give it one, and save it again.")
    for frames in dict.fromkeys((0, options["finetune_frames"])):
        model, train_env = load_agent(options, 1, planner=options["planner"], freeze_decoder=options["freeze_decoder"])
        prepare_zero_shot(model, frames)
        env = environment_of(options, envs)
        played = run_evaluation(model, env, options["episodes"], options["seed"], "on")
        how = "fine_tuned" if frames else "zero_shot"
        episodes = counted(len(played.returns), "episode")
        print(f"{options['env']}, {how}: return {played.mean:.1f} ± {played.std:.1f} ({episodes})")
        if "rows" in options:
            columns = {"adaptation": how, "known_reward": "true", "snapshot": options["snapshot"]}
            append_row(options["rows"], row_of(model, env, played, keep_actor=False, **columns))
        if frames and "save" in options:
            save(model, options["save"])
        train_env.close()
        env.close()
    return 0


def save(model: DreamerV2, path: Path) -> None:
    """Write a model and, beside it, what normalises its observations.

    :param model: in its environment
    :param path: of the snapshot
    """
    from sb3_dreamer_urlb.snapshots.vec_normalize import beside, save_vec_normalize

    model.save(path)
    if (normalizer := model.get_vec_normalize_env()) is not None:
        save_vec_normalize(normalizer, beside(path))
