"""The paper's ablations: list their runs, and do what is missing. Started again, it goes on."""

from __future__ import annotations

import argparse
from typing import Any

from sb3_dreamer_urlb.command_parser import a_path, at_least

HELP = "list the runs of one of the paper's ablations, and do those that are missing"
#: options that change the paper's plan
PLANNED = ("methods", "tasks", "seeds", "pretrain_frames", "finetune_frames")
NAMES = ("known-reward", "zero-shot", "modules", "longer", "sparsity")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """
    :param parser: of this command
    """
    parser.add_argument("name", choices=NAMES, help="which ablation")
    parser.add_argument("action", choices=("list", "run"), help="say what is done and what is missing, or do it")
    parser.add_argument("--folder", type=a_path, required=True, help="of the study: rows.csv, snapshots, runs under way")
    parser.add_argument("--methods", nargs="+", help="intrinsic rewards (default: the paper's)")
    parser.add_argument("--tasks", nargs="+", help="such as walker-run (default: the paper's)")
    parser.add_argument("--scratch", action="store_true", help="beside it, agents that learn each task without pre-training")
    parser.add_argument("--seeds", type=at_least(1), help="how many (default: 3)")
    parser.add_argument(
        "--pretrain-frames", type=at_least(1), nargs="+", help="lengths of the pre-training (default: the paper's)"
    )
    parser.add_argument("--finetune-frames", type=at_least(1), help="(default: 100000)")
    parser.add_argument("--episodes", type=at_least(1), default=10, help="of an evaluation (default: %(default)s)")
    parser.add_argument("--preset", default="paper", help="of the models (default: %(default)s)")
    choices = ("pixels", "state")
    parser.add_argument(
        "--observation",
        choices=choices,
        default=choices[0],
        help="state: normalised, with --preset state-small (default: pixels)",
    )
    parser.add_argument("--minutes", type=float, default=float("inf"), help="begin no run after so many")
    parser.add_argument("--at-most", type=at_least(1), help="fine-tunings")
    parser.add_argument("--device", default="auto", help="(default: %(default)s)")


def run(options: dict[str, Any]) -> int:
    """
    :param options: of the command line
    :return: exit status
    :raises ValueError: for a study without runs, or unknown tasks
    """
    from dataclasses import replace

    from stable_baselines3.common.env_util import make_vec_env

    from sb3_dreamer_urlb.analysis.manifests import MANIFESTS, runs_of
    from sb3_dreamer_urlb.analysis.study import StudyFolder, normalized_states
    from sb3_dreamer_urlb.devices import known_device
    from sb3_dreamer_urlb.dreamer_v2.presets import get_preset
    from sb3_dreamer_urlb.intrinsic import make_intrinsic_reward

    if not options["minutes"] > 0:
        raise ValueError(f"--minutes must be more than 0, got {options['minutes']}.")
    known_device(options["device"], "--device")
    get_preset(options["preset"])
    given: dict[str, Any] = {name.removesuffix("_frames"): options[name] for name in PLANNED if name in options}
    manifest = MANIFESTS[options["name"]]
    given = {name: tuple(one) if isinstance(one, list) else one for name, one in given.items()}
    plan = replace(manifest.plan, **given)
    for method in plan.methods:
        make_intrinsic_reward(method)
    runs = runs_of(options["name"], plan, options["scratch"])
    arguments = {"preset": options["preset"], "device": options["device"]}
    make_env = normalized_states if options["observation"] == "state" else make_vec_env
    study = StudyFolder(options["folder"], arguments, options["episodes"], make_env)
    if options["action"] == "list":
        missing = set(study.missing(runs))
        for one in runs:
            print("missing" if one in missing else "done   ", one.name)
        print(f"{len(runs) - len(missing)} of {len(runs)} done; figure {manifest.figure} of `figures {study.rows}`")
        return 0
    try:
        study.work(runs, options["minutes"], options.get("at_most"))
    except KeyboardInterrupt:
        raise KeyboardInterrupt("interrupted; the same command goes on where it was.") from None
    return 0
