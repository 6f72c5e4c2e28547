"""Evaluate a saved agent as the paper does: 10 episodes with fixed seeds, deterministic, with or without the planner."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zipfile import BadZipFile

from sb3_dreamer_urlb.cli.agents import (
    add_evaluation_arguments,
    add_statistics_argument,
    environments_at_a_time,
    load_agent,
    pairs,
    typed,
)
from sb3_dreamer_urlb.command_parser import a_path
from sb3_dreamer_urlb.folders import made_folder
from sb3_dreamer_urlb.phases import PRETRAINING

if TYPE_CHECKING:
    from sb3_dreamer_urlb.evaluation.episodes import Evaluation
    from sb3_dreamer_urlb.evaluation.row import Row

HELP = "evaluate a saved agent: episodes with fixed seeds, a row of a CSV file, evaluations.npz"
BOTH = "both"
NPZ = "evaluations.npz"
#: columns of a row that nobody may set, with the result itself
MEASURED = frozenset(("seconds", "planner", "evaluation_seed", "returns", "versions", "written"))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """
    :param parser: of this command
    """
    parser.add_argument("snapshot", type=a_path, help="what model.save wrote, or the folder of a run")
    add_evaluation_arguments(parser)
    choices = ("auto", "on", "off", BOTH)
    parser.add_argument("--planner", choices=choices, default="auto", help="who acts; both plays twice (default: %(default)s)")
    parser.add_argument("--stochastic", action="store_true", help="explore as in training")
    parser.add_argument("--rows", type=a_path, help="CSV file that a row is added to")
    parser.add_argument(
        "--npz", type=a_path, help="folder of a new evaluations.npz, as EvalCallback's; of both, the planner's"
    )
    parser.add_argument("--set", nargs="+", metavar="COLUMN=VALUE", help="columns of the row: arm=mine keep_actor=false")
    add_statistics_argument(parser)
    parser.add_argument("--device", default="auto", help="(default: %(default)s)")


def run(options: dict[str, Any]) -> int:
    """
    :param options: of the command line
    :return: exit status
    :raises ValueError: for options that do not fit the snapshot or each other
    :raises FileNotFoundError: if there is no snapshot
    """
    import numpy as np

    from sb3_dreamer_urlb.evaluation.agent_rows import results_of, row_of
    from sb3_dreamer_urlb.evaluation.append import RowsDisagree, append_row, check_can_append
    from sb3_dreamer_urlb.evaluation.episodes import expected, run_evaluation
    from sb3_dreamer_urlb.snapshots.atomic import written_atomically

    if "set" in options and "rows" not in options:
        raise ValueError("--set is about the row: it needs --rows FILE.")
    about = {"snapshot": options["snapshot"], **_columns(options.get("set", ()))}
    if "rows" in options:
        check_can_append(options["rows"])
    if "npz" in options:
        made_folder("--npz", options["npz"])
    model, env = load_agent(options, environments_at_a_time(options))
    played, refused = [], None
    try:
        how = [
            (options["episodes"], options["seed"], chosen, not options["stochastic"]) for chosen in _planners(model, options)
        ]
        rows = [row_of(model, env, expected(model, *which), **about) for which in how]
        if "rows" in options:
            _check_fits(model, about)
            check_can_append(options["rows"], rows)
        if "npz" in options:
            _check_replaces_no_others(options["npz"] / NPZ, model.num_timesteps)
        _say_what_is_unusual(model, rows[0])
        for which in how:
            played.append(run_evaluation(model, env, *which))
            _print(options, played[-1], rows[0])
            if "rows" not in options:
                continue
            try:
                added = append_row(options["rows"], row_of(model, env, played[-1], **about))
                print(f"  {'added to' if added else 'stands already in'} {options['rows']}")
            except RowsDisagree as error:
                # What is still to be played, and the file of all episodes, do not suffer from it.
                refused = error
    finally:
        env.close()
    if "npz" in options:
        with written_atomically(options["npz"] / NPZ) as file:
            np.savez(file, **results_of(played[:1], [model.num_timesteps]))  # type: ignore[arg-type]
    if refused is not None:
        raise refused
    return 0


def _planners(model: Any, options: dict[str, Any]) -> tuple[str, ...]:
    if options["planner"] != BOTH:
        return (options["planner"],)
    return ("off",) if getattr(model, "planner", None) is None else ("on", "off")


def _check_fits(model: Any, about: dict[str, Any]) -> None:
    """Whether columns that somebody set can be true of the agent."""
    from sb3_dreamer_urlb.evaluation.agent_rows import was_fine_tuned

    if model.seed is None and "seed" not in about:
        raise ValueError("The model has no seed, and rows tell runs apart by it: --set seed=...")
    kept = [name for name in ("keep_actor", "keep_critic") if about.get(name) is not None]
    if kept and not was_fine_tuned(model):
        raise ValueError(f"--set {kept[0]}: the agent was not fine-tuned from a pre-trained one, so that it kept nothing.")


def _check_replaces_no_others(path: Path, steps: int) -> None:
    """A run keeps all its evaluations in a file of that name."""
    import numpy as np

    if not path.exists():
        return
    try:
        with np.load(path) as file:
            there = file["timesteps"].tolist()
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):
        there = None
    if there != [steps]:
        what = "cannot be read" if there is None else f"holds evaluations after {', '.join(map(str, there[:5]))} steps"
        raise ValueError(f"--npz: {path} {what}, this one is after {steps}: give another folder.")


def _say_what_is_unusual(model: Any, row: Row) -> None:
    from sb3_dreamer_urlb.evaluation.rows import LEARNT

    if model.phase == PRETRAINING:
        print(f"The agent is still exploring ({model.phase_frames} frames of pre-training): it seeks no reward of a task.")
    if row[LEARNT]:
        print(f"The agent has learnt {row[LEARNT]}, and plays {row.domain}-{row.task}: a row says so, and no table has it.")


def _columns(texts: Any) -> dict[str, Any]:
    """What --set says, checked as a row is: nothing of it may be found wrong after the episodes."""
    from dataclasses import replace

    from sb3_dreamer_urlb.evaluation.names import method_name
    from sb3_dreamer_urlb.evaluation.rows import REQUIRED, RESULT, Row, parse
    from sb3_dreamer_urlb.evaluation.rows import texts as written

    given = pairs("--set", texts)
    if clash := sorted(given.keys() & MEASURED.union(RESULT)):
        raise ValueError(f"--set {', '.join(clash)}: the evaluation measures that; other columns may be set.")
    columns = {name: typed(text) if name in REQUIRED else text for name, text in given.items()}
    for name in columns.keys() & {"keep_actor", "keep_critic"}:
        if columns[name] is not None and not isinstance(columns[name], bool):
            raise ValueError(f"--set {name}: expected true, false or none, got {columns[name]!r}.")
    if "method" in columns:
        columns["method"] = method_name(str(columns["method"]))
    blank = Row("lbs", "walker", "run", 0, 0, 0, None, None, "none", "paper", 0.0, 0.0, 1)
    required: dict[str, Any] = {name: value for name, value in columns.items() if name in REQUIRED}
    further = {name: value for name, value in columns.items() if name not in REQUIRED}
    try:
        parse(written(replace(blank, **required, further=further)), strict=False)
    except ValueError as error:
        raise ValueError(f"--set {error}") from error
    return columns


def _print(options: dict[str, Any], played: Evaluation, row: Row) -> None:
    from sb3_dreamer_urlb.evaluation.names import TASKS, counted
    from sb3_dreamer_urlb.evaluation.scores import normalized_score

    who = "actor alone" if played.planner == "none" else f"planner {played.planner}"
    line = f"{options['env']}, {who}: return {played.mean:.1f} ± {played.std:.1f} ({counted(len(played.returns), 'episode')}"
    name = f"{row.domain}-{row.task}"
    known = name in TASKS and row.is_of_the_benchmark
    score = f", {100 * normalized_score(name, played.mean):.1f} % of Dreamer@2M" if known else ""
    print(f"{line}, {played.seconds:.0f} s){score}")
