"""Figures of tasks that were changed: perturbed bodies, rewards of another sparsity. None where there is no run to show."""

from __future__ import annotations

from typing import Any

from sb3_dreamer_urlb.evaluation.aggregate import Estimate, mean_and_error
from sb3_dreamer_urlb.evaluation.arms import Arm, Study, acts, any_task, kept, plans, scratch
from sb3_dreamer_urlb.evaluation.figure_parts import after, is_method, normalized, seeds, split_by, unscored
from sb3_dreamer_urlb.evaluation.names import LEVELS, method
from sb3_dreamer_urlb.evaluation.rows import Row
from sb3_dreamer_urlb.evaluation.style import COLUMN, PAGE, Picture, bars, finish, frames_label, new_figure


def perturbed(study: Study) -> Picture | None:
    """Paper, figure "RWRL tasks": fine-tuning in perturbed environments."""

    def changed(row: Row) -> bool:
        return row["perturbation"] in LEVELS and row.is_of_the_benchmark

    tasks = sorted({(row.domain, row.task) for row in study.rows if changed(row)}, key=lambda one: (one[0] != "walker", one))
    if not tasks:
        return None
    arms = [
        study.arm(f"DreamerV2@{frames_label(n)}", any_task, changed, scratch, lambda row: row.method == "dreamer", frames=n)
        for n in (study.finetune, 1_000_000, 2_000_000)
    ]
    for name in study.methods:
        # As it was run: with the planner where there is one.
        for label, planner in ((method(name).label, acts), (f"{method(name).label} + Dyna-MPC", plans)):
            arms.append(study.pretrained(label, any_task, changed, planner, is_method(name)))
    arms = [arm for arm in arms if arm.rows]
    study.show(arms)
    figure, panels = new_figure(len(tasks), PAGE if len(tasks) > 1 else COLUMN * 1.3)
    handles: list[Any] = []
    for axes, (domain, task) in zip(panels, tasks, strict=True):
        series = {arm.label: [_return_at(arm, domain, task, "perturbation", level) for level in LEVELS] for arm in arms}
        handles = bars(axes, LEVELS, series, [1] * 3, scale=1)
        axes.set(title=f"{domain} {task}", ylabel="return")
    caption = (
        f"Tasks with the perturbations of the Real-World RL suite, {after(study)} (pre-training without perturbations). "
        f"Undiscounted return, mean over seeds ± standard error; {seeds(split_by(arms, 'perturbation'))}."
    )
    return finish("perturbed", figure, caption, study.synthetic, handles)


def _return_at(arm: Arm, domain: str, task: str, column: str, value: str) -> Estimate:
    rows = tuple(row for row in arm.rows if (row.domain, row.task, row[column]) == (domain, task, value))
    return mean_and_error(Arm(arm.label, rows).scores(None))


def sparsity(study: Study) -> Picture | None:
    """Paper, appendix "On the sparsity of the Jaco tasks": with and without the pre-trained actor."""
    # The same methods for every reward.
    methods = {row.method for row in study.rows if row["variant"] in ("sparse", "dense")}
    if not methods:
        return None
    arms = [
        study.pretrained(label, any_task, acts, kept(actor, False), _jaco, lambda row: row.method in methods)
        for label, actor in (("model", False), ("model + actor", True))
    ]
    without = unscored(arms)
    arms = [arm.scored() for arm in arms]
    study.show(arms)
    kinds = {"sparser": "sparse", "as in URLB": "", "denser": "dense"}
    figure, [axes] = new_figure(1, COLUMN * 1.3)
    series = {
        arm.label: [
            mean_and_error(Arm("", tuple(row for row in arm.rows if row["variant"] == kind)).scores(study.normalizer))
            for kind in kinds.values()
        ]
        for arm in arms
    }
    handles = bars(axes, list(kinds), series, [4] * 3)
    axes.set(ylabel="normalised score (%)", title="Sparsity of the Jaco tasks")
    caption = (
        f"Jaco reaching with a smaller and a larger rewarded area, {after(study)}; all methods together. "
        f"{normalized(study)}, mean over tasks ± standard error; {seeds(split_by(arms, 'variant'))}.{without}"
    )
    return finish("sparsity", figure, caption, study.synthetic, handles)


def _jaco(row: Row) -> bool:
    return row.domain == "jaco" and row.is_of_the_benchmark and not row["perturbation"] and row["variant"] != "fixed"
