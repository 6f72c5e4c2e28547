"""Which rows belong together: the arms that the paper's tables and figures compare."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from sb3_dreamer_urlb.evaluation.aggregate import NEAR, Scores, final_rows, scores_of
from sb3_dreamer_urlb.evaluation.names import METHODS, TASKS, method
from sb3_dreamer_urlb.evaluation.rows import NONE, Row
from sb3_dreamer_urlb.evaluation.scores import DREAMER_2M
from sb3_dreamer_urlb.transfer_rule import keeps_actor

#: budgets of the benchmark, in environment frames (paper §2)
FINETUNE, PRETRAIN = 100_000, 2_000_000
DYNA_MPC, MPPI = "dyna_mpc", "mppi"

Condition = Callable[[Row], bool]


@dataclass(frozen=True)
class Arm:
    """Rows that are compared with others, one of each run.

    :param label: in tables and figures
    :param rows: their last evaluations
    """

    label: str
    rows: tuple[Row, ...]

    def scores(self, normalizer: str | None = DREAMER_2M) -> Scores:
        """Scores by task; returns for None. Tasks without a reference are left out of scores."""
        return scores_of((row for row in self.rows if normalizer is None or f"{row.domain}-{row.task}" in TASKS), normalizer)


def standard(row: Row) -> bool:
    """Of the benchmark itself: no perturbation, no changed reward, reward unknown before fine-tuning."""
    return not (row["perturbation"] or row["variant"]) and row["known_reward"] in ("", "false")


def plans(row: Row) -> bool:
    """With Dyna-MPC."""
    return row.planner == DYNA_MPC


def acts(row: Row) -> bool:
    """The actor alone."""
    return row.planner == NONE


def task_aware(row: Row) -> bool:
    """Fine-tuned as the paper's rule has it: the actor where rewards are dense, never the critic (§3)."""
    return row.keep_actor == keeps_actor(row.domain) and not row.keep_critic


def kept(actor: bool, critic: bool) -> Condition:
    """Fine-tuned from these modules, whatever the task."""
    return lambda row: row.keep_actor is actor and bool(row.keep_critic) is critic


def scratch(row: Row) -> bool:
    """Without pre-training."""
    return row.pretrain_frames == 0


class Study:
    """All rows of some files, and the budgets that they are compared at.

    :param rows: of any number of runs
    :param finetune: budget of fine-tuning in frames; None takes the paper's 100k, or what most runs with pre-training reached
    :param pretrain: length of the pre-training; None takes the paper's 2M, or the longest there is
    :param normalizer: of scores
    """

    def __init__(
        self, rows: Iterable[Row], finetune: int | None = None, pretrain: int | None = None, normalizer: str = DREAMER_2M
    ):
        self.rows = tuple(rows)
        self.normalizer = normalizer
        lengths = {row.pretrain_frames for row in self.rows}
        self.pretrain = pretrain or (PRETRAIN if PRETRAIN in lengths else max(lengths, default=0))
        tuned = [row.finetune_frames for row in self.rows if row.pretrain_frames] or [row.finetune_frames for row in self.rows]
        at_paper_s = any(abs(frames - FINETUNE) <= NEAR * FINETUNE for frames in tuned)
        self.finetune = finetune or (FINETUNE if at_paper_s else max(tuned, default=FINETUNE))
        #: last rows of runs that never came to the end of the budget
        self.unfinished: list[Row] = []
        self.done, self.unfinished = final_rows(self.rows, self.finetune)
        self.unfinished = [row for row in self.unfinished if row.finetune_frames > 0]

    @property
    def methods(self) -> list[str]:
        """Exploration methods with pre-trained runs, in the package's order."""
        found = {row.method for row in self.rows if row.pretrain_frames}
        return sorted(found, key=lambda name: (list(METHODS).index(name) if name in METHODS else len(METHODS), name))

    @property
    def synthetic(self) -> bool:
        """Whether any row was made up, and says so in a column of that name."""
        return any(row["synthetic"] in ("true", "1", "yes") for row in self.rows)

    def arm(self, label: str, *conditions: Condition, frames: int | None = None) -> Arm:
        """The runs of the standard benchmark for which all conditions hold.

        :param label: of the arm
        :param conditions: on rows; the first may be :func:`any_task` to leave the standard benchmark
        :param frames: of fine-tuning, None for the study's budget
        """
        rows = self.done if frames is None else final_rows(self.rows, frames)[0]
        needed = conditions if any_task in conditions else (standard, *conditions)
        return Arm(label, tuple(row for row in rows if all(condition(row) for condition in needed)))

    def pretrained(self, label: str, *conditions: Condition) -> Arm:
        """As :meth:`arm`, of runs with the study's length of pre-training."""
        return self.arm(label, lambda row: row.pretrain_frames == self.pretrain > 0, *conditions)

    def approaches(self) -> list[Arm]:
        """The arms of the paper's first table, and their like for every other method: those that have rows."""
        arms = [
            self.arm("DrQv2", scratch, lambda row: row.method == "drqv2"),
            self.arm("DreamerV2", scratch, acts, lambda row: row.method == "dreamer"),
        ]
        for name in self.methods:
            label = method(name).label

            def own(row: Row, name: str = name) -> bool:
                return row.method == name

            if name == "disagreement":
                arms.append(self.pretrained(label, own))
                continue
            # Only where the rule drops the actor, keeping it is another thing.
            if any(not keeps_actor(row.domain) and row.keep_actor for row in self.rows if own(row) and standard(row)):
                arms.append(self.pretrained(label, own, acts, kept(True, False)))
            arms.append(self.pretrained(f"{label} + task-aware FT", own, acts, task_aware))
            arms.append(self.pretrained(f"{label} + Dyna-MPC", own, plans, task_aware))
        return [arm for arm in arms if arm.rows]

    def mixtures(self, columns: Sequence[str] = ("preset", "observation", "algorithm", "arm")) -> list[str]:
        """Warnings where runs that differ in more than seed and task would be averaged."""
        lines = []
        for name in sorted({row.method for row in self.rows}):
            for column in columns:
                values = {row[column] for row in self.rows if row.method == name}
                if len(values) > 1:
                    shown = ", ".join(repr(value) for value in sorted(values))
                    lines.append(f"{name}: {column} is {shown}; --where {column}=... keeps one of them")
        return lines


def any_task(row: Row) -> bool:
    """Always; as a condition it lets rows of changed tasks in."""
    return True
