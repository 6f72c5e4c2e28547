"""Which rows belong together: the arms that the paper's tables and figures compare."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

from sb3_dreamer_urlb.evaluation.aggregate import NEAR, Scores, final_rows, scores_of
from sb3_dreamer_urlb.evaluation.names import METHODS, TASKS, method
from sb3_dreamer_urlb.evaluation.rows import NONE, REQUIRED, Row
from sb3_dreamer_urlb.evaluation.scores import DREAMER_2M
from sb3_dreamer_urlb.number_checks import check_integer
from sb3_dreamer_urlb.transfer_rule import keeps_actor

#: budgets of the benchmark, in environment frames (paper §2)
FINETUNE, PRETRAIN = 100_000, 2_000_000
DYNA_MPC, MPPI = "dyna_mpc", "mppi"
#: columns that arms are told apart by
CHANGING = ("perturbation", "variant", "known_reward", "adaptation", "synthetic")

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
        return scores_of((self.rows if normalizer is None else self.scored().rows), normalizer)

    def scored(self) -> Arm:
        """Without the tasks that have no reference score: no figure of scores shows them, none counts their seeds."""
        return replace(self, rows=tuple(row for row in self.rows if f"{row.domain}-{row.task}" in TASKS))

    def unscored_tasks(self) -> set[str]:
        """The tasks that :meth:`scored` leaves out, ``<domain>-<task>``."""
        return {f"{row.domain}-{row.task}" for row in self.rows} - set(TASKS)

    def only(self, condition: Condition) -> Arm:
        """Its rows for which a condition holds."""
        return replace(self, rows=tuple(row for row in self.rows if condition(row)))


def standard(row: Row) -> bool:
    """Of the benchmark itself: no perturbation, no changed reward or task, reward unknown before fine-tuning."""
    return row.is_of_the_benchmark and not (row["perturbation"] or row["variant"]) and row["known_reward"] != "true"


def settled(rows: Iterable[Row]) -> Condition:
    """Of the benchmark's tasks as the analyses of known rewards have them: no perturbation, no changed reward; of Jaco the
    ``fixed`` target, the only one that pre-training can know, if any row has it.

    :param rows: that are to be told apart
    """
    fixed = any(row.domain == "jaco" and row["variant"] == "fixed" for row in rows)

    def condition(row: Row) -> bool:
        variant = "fixed" if fixed and row.domain == "jaco" else ""
        return row.is_of_the_benchmark and not row["perturbation"] and row["variant"] == variant

    return condition


def like(others: Iterable[Row], *varied: str) -> Condition:
    """Of a setting that one of some other rows has.

    :param others: rows to compare with
    :param varied: columns that may differ from theirs, see :meth:`Row.setting`
    """
    settings = {row.setting(*varied) for row in others}
    return lambda row: row.setting(*varied) in settings


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
        for name, value in (("finetune", finetune), ("pretrain", pretrain)):
            if value is not None:
                check_integer(f"{name} frames", value, 1)
        self.rows = tuple(rows)
        self.normalizer = normalizer
        lengths = {row.pretrain_frames for row in self.rows}
        self.pretrain = pretrain or (PRETRAIN if PRETRAIN in lengths else max(lengths, default=0))
        tuned = [row.finetune_frames for row in self.rows if row.pretrain_frames] or [row.finetune_frames for row in self.rows]
        at_paper_s = any(abs(frames - FINETUNE) <= NEAR * FINETUNE for frames in tuned)
        self.finetune = finetune or (FINETUNE if at_paper_s else max(tuned, default=FINETUNE))
        #: rows of runs that have no evaluation at the budget
        self.unfinished: list[Row] = []
        self.done, self.unfinished = final_rows(self.rows, self.finetune)
        self.unfinished = [row for row in self.unfinished if row.finetune_frames > 0]
        self._shown: set[int] = set()

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

    def pretrained(self, label: str, *conditions: Condition, frames: int | None = None) -> Arm:
        """As :meth:`arm`, of runs with the study's length of pre-training."""
        return self.arm(label, lambda row: row.pretrain_frames == self.pretrain > 0, *conditions, frames=frames)

    def show(self, arms: Iterable[Arm]) -> None:
        """Note that a table or a figure shows these arms.

        :param arms: with the rows that are shown
        """
        self._shown.update(id(row) for arm in arms for row in arm.rows)

    def left_out(self) -> list[Row]:
        """Rows at the end of their run that nothing has shown so far, zero-shot ones included."""
        shot, _ = final_rows((row for row in self.rows if row.planner != NONE), 0)
        return [row for row in (*self.done, *shot) if id(row) not in self._shown]

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

    def mixtures(self) -> list[str]:
        """Warnings where runs that differ in more than seed and task would be averaged."""
        lines = []
        further = {name for row in self.rows for name, _ in row.setting(*REQUIRED, *CHANGING)}
        columns = ("preset", *sorted(further))
        for name in sorted({row.method for row in self.rows}):
            for column in columns:
                values = {str(row[column]) for row in self.rows if row.method == name}
                if len(values) > 1:
                    shown = ", ".join(repr(value) for value in sorted(values))
                    lines.append(f"{name}: {column} is {shown}; --where {column}=... keeps one of them")
        return lines


def any_task(row: Row) -> bool:
    """Always; as a condition it lets rows of changed tasks in."""
    return True
