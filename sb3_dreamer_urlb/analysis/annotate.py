"""Measurements become columns of evaluation rows: ``sb3-dreamer-urlb figures`` draws them from there."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from sb3_dreamer_urlb.evaluation.agent_rows import agent_columns, env_columns
from sb3_dreamer_urlb.evaluation.append import change_rows
from sb3_dreamer_urlb.evaluation.rows import NONE, Row, read_rows
from sb3_dreamer_urlb.planning import planner_name

#: columns of measurements
DISCREPANCY, INTRINSIC_REWARD = "ldd", "intrinsic_reward"
#: columns that make another task of a task
CHANGES = ("observation", "perturbation", "variant")
#: columns in which the rows about one agent may differ: who acted, and what the planning is called
OF_ONE_AGENT = ("planner", "adaptation")
#: columns in which agents may differ that were fine-tuned from one pre-training
FROM_ONE_PRETRAINING = (*OF_ONE_AGENT, "finetune_frames", "keep_actor", "keep_critic", "known_reward")


def about(model: Any, env: VecEnv, tuned: bool) -> Callable[[Row], bool]:
    """Whether a row is about a snapshot on a task, by everything that the snapshot knows of itself.

    :param model: the snapshot
    :param env: of the task
    :param tuned: of what was fine-tuned from it for any number of frames; False: of just this fine-tuned snapshot
    """
    task, own = env_columns(env), agent_columns(model)
    acting = (NONE, (planner_name(getattr(model, "planner", None)) or NONE).lower())

    def matches(row: Row) -> bool:
        same = (row.method, row.domain, row.task, row.seed) == (own["method"], task["domain"], task["task"], own["seed"])
        same = same and row.pretrain_frames == own["pretrain_frames"]
        same = same and all(row[name] == task.get(name, "") for name in CHANGES)
        # Somebody else's rows, and old snapshots, may not say these.
        said = [name for name in ("preset", "algorithm") if row[name] and own.get(name)]
        same = same and all(row[name] == own[name] for name in said)
        if tuned:
            return same and row.finetune_frames > 0
        kept = [name for name in ("keep_actor", "keep_critic") if own.get(name) is not None]
        same = same and all(row[name] is own[name] for name in kept)
        known = row["known_reward"] == "true", own.get("known_reward") == "true"
        same = same and (known[0] == known[1] or not kept)
        return same and row.planner in acting and row.finetune_frames == own["finetune_frames"]

    return matches


def check_has_rows(
    path: str | os.PathLike[str], matches: Callable[[Row], bool], varied: tuple[str, ...] = OF_ONE_AGENT
) -> None:
    """Whether :func:`annotate` will know where to write, before anything is measured.

    :param path: of the CSV file of evaluations
    :param matches: which rows
    :param varied: columns in which these rows may differ; in any other they are about several agents
    :raises FileNotFoundError: if there is no such file
    :raises ValueError: if no row matches (evaluate the fine-tuned agent first), or rows of several agents do
    """
    if not Path(path).exists():
        raise FileNotFoundError(f"There is no file {path} of evaluations: evaluate the fine-tuned agent first.")
    settings = [dict(row.setting(*varied)) for row in read_rows(path, strict=False).rows if matches(row)]
    if not settings:
        raise ValueError(f"{path} has no row about this agent and task: evaluate the fine-tuned agent first.")
    names = sorted({name for one in settings for name in one})
    if differ := [name for name in names if len({one.get(name) for one in settings}) > 1]:
        raise ValueError(
            f"{path} has {len(settings)} rows that may be about this agent, and they differ in {', '.join(differ)}, which a "
            "snapshot does not tell: keep the rows of this agent in a file of their own."
        )


def annotate(
    path: str | os.PathLike[str],
    matches: Callable[[Row], bool],
    column: str,
    value: float,
    varied: tuple[str, ...] = OF_ONE_AGENT,
) -> int:
    """Write a number into a column of the rows that it is about.

    :param path: of the CSV file of evaluations
    :param matches: which rows
    :param column: of ``DESCRIBING``, so that it does not tell runs apart
    :param value: to write
    :param varied: columns in which these rows may differ; in any other they are about several agents
    :return: how many rows have it now
    :raises FileNotFoundError: see :func:`check_has_rows`
    :raises ValueError: likewise; the file is as it was
    """
    check_has_rows(path, matches, varied)
    return change_rows(path, matches, {column: repr(float(value))})
