"""Measurements become columns of evaluation rows: ``sb3-dreamer-urlb figures`` draws them from there."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from sb3_dreamer_urlb.evaluation.agent_rows import agent_columns, env_columns
from sb3_dreamer_urlb.evaluation.append import change_rows
from sb3_dreamer_urlb.evaluation.rows import Row

#: columns of measurements
DISCREPANCY, INTRINSIC_REWARD = "ldd", "intrinsic_reward"
#: columns that make another task of a task
CHANGES = ("observation", "perturbation", "variant")


def about(model: Any, env: VecEnv, tuned: bool) -> Callable[[Row], bool]:
    """Whether a row is about a snapshot on a task.

    :param model: the snapshot
    :param env: of the task
    :param tuned: of what was fine-tuned from it for any number of frames; False: of just this fine-tuned snapshot
    """
    task, own = env_columns(env), agent_columns(model)

    def matches(row: Row) -> bool:
        same = (row.method, row.domain, row.task, row.seed) == (own["method"], task["domain"], task["task"], own["seed"])
        frames = row.finetune_frames > 0 if tuned else row.finetune_frames == own["finetune_frames"]
        same = same and all(row[name] == task.get(name, "") for name in CHANGES)
        return same and row.pretrain_frames == own["pretrain_frames"] and frames

    return matches


def annotate(path: str | os.PathLike[str], matches: Callable[[Row], bool], column: str, value: float) -> int:
    """Write a number into a column of the rows that it is about.

    :param path: of the CSV file of evaluations
    :param matches: which rows
    :param column: of ``DESCRIBING``, so that it does not tell runs apart
    :param value: to write
    :return: how many rows have it now
    :raises FileNotFoundError: if there is no such file
    :raises ValueError: if no row matches: evaluate the fine-tuned agent first; the file is as it was
    """
    if not Path(path).exists():
        raise FileNotFoundError(f"There is no file {path} of evaluations: evaluate the fine-tuned agent first.")
    changed = change_rows(path, matches, {column: repr(float(value))})
    if changed == 0:
        raise ValueError(f"{path} has no row about this agent and task: evaluate the fine-tuned agent first.")
    return changed
