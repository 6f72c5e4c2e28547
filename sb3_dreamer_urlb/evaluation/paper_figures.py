"""The paper's figures, from rows. Each function gives None where there is not one run to show."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from sb3_dreamer_urlb.evaluation.aggregate import REPETITIONS, performance_profile
from sb3_dreamer_urlb.evaluation.arms import (
    MPPI,
    Arm,
    Study,
    acts,
    any_task,
    kept,
    like,
    plans,
    scratch,
    settled,
    task_aware,
)
from sb3_dreamer_urlb.evaluation.changed_task_figures import perturbed, sparsity
from sb3_dreamer_urlb.evaluation.figure_parts import after, domain_bars, normalized, seeds, unscored
from sb3_dreamer_urlb.evaluation.names import TASKS, method
from sb3_dreamer_urlb.evaluation.rows import Row
from sb3_dreamer_urlb.evaluation.scatter import scatter
from sb3_dreamer_urlb.evaluation.snapshot_figures import longer_pretraining, snapshots_by_category, snapshots_by_method
from sb3_dreamer_urlb.evaluation.style import COLORS, COLUMN, STYLES, Picture, finish, frames_label, new_figure


def benchmark(study: Study) -> Picture | None:
    """Paper, figure "URL Benchmark": every approach by domain."""
    arms = _shown(study)
    return domain_bars(study, "benchmark", arms, "URL benchmark", f"Approaches {after(study)}.")


def _shown(study: Study) -> list[Arm]:
    """The approaches, no more than there are colours for: all of them stand in the table."""
    arms = study.approaches()
    if len(arms) <= len(COLORS):
        return arms
    # Of other methods than the paper's figure has, the full one is enough.
    full = [arm for arm in arms if "+" not in arm.label or arm.label.startswith("P2E") or arm.label.endswith("Dyna-MPC")]
    bare = {method(name).label for name in study.methods} - {"Disagreement", "P2E"}
    return [arm for arm in full if arm.label not in bare]


def modules(study: Study) -> Picture | None:
    """Paper, figure "Task-aware fine-tuning": which pre-trained modules are kept, over all methods."""
    arms = [
        study.pretrained("model", acts, kept(False, False)),
        study.pretrained("model + actor", acts, kept(True, False)),
        study.pretrained("model + actor + critic", acts, kept(True, True)),
    ]
    caption = f"Pre-trained modules that fine-tuning starts from, {after(study)}; all exploration methods together."
    return domain_bars(study, "modules", arms, "Module ablation", caption, COLUMN * 1.3)


def planning(study: Study) -> Picture | None:
    """Paper, figure "Dyna-MPC": fine-tuning with and without the planner, over all methods."""
    arms = [study.pretrained("actor alone", acts, task_aware), study.pretrained("Dyna-MPC", plans, task_aware)]
    if not all(arm.rows for arm in arms):
        return None
    # The same methods and settings on both sides, or the comparison is one of them.
    varied = ("planner", "finetune_frames", "domain", "task", "seed", "keep_actor")
    arms = [arm.only(like(other.rows, *varied)) for arm, other in zip(arms, reversed(arms), strict=True)]
    names = ", ".join(method(name).label for name in study.methods if any(row.method == name for row in arms[0].rows))
    caption = f"Fine-tuning with and without Dyna-MPC {after(study)}; {names}."
    return domain_bars(study, "planning", arms, "Dyna-MPC", caption, COLUMN * 1.3)


def known_reward(study: Study) -> Picture | None:
    """Paper, figure "reward ablation": the reward is learnt in fine-tuning, or known from pre-training on."""

    # What planned alone has a figure of its own.
    alike = study.pretrained("", any_task, settled(filter(_knows, study.rows)), lambda row: not _mppi(row))
    known = replace(alike.only(_knows), label="reward known")
    if not known.rows:
        return None
    # Like with like: settings that were run with the reward known.
    same = like(known.rows, "known_reward", "finetune_frames", "seed")
    unknown = alike.only(lambda row: not _knows(row) and same(row))
    unknown = replace(unknown, label="reward learnt while fine-tuning")
    caption = f"Reward predictor from pre-training on, or from scratch, {after(study)}."
    return domain_bars(study, "known_reward", [unknown, known], "Known reward", caption, COLUMN * 1.3)


def zero_shot(study: Study) -> Picture | None:
    """Paper, figure "Zero-shot (ZS) vs fine-tuned (FT)": planning with the pre-trained model, and after fine-tuning."""
    shot, tuned = _planning_alone(study)
    if not (shot.rows or tuned.rows):
        return None
    if shot.rows and tuned.rows:
        # The same methods and settings on both sides, whichever tasks and seeds are there.
        varied = ("finetune_frames", "adaptation", "domain", "task", "variant", "seed")
        shot, tuned = shot.only(like(tuned.rows, *varied)), tuned.only(like(shot.rows, *varied))
    same_task = settled((*shot.rows, *tuned.rows))
    without = study.arm("DreamerV2, no pre-training", any_task, scratch, acts, same_task, _is_dreamer)
    arms = [without, shot, tuned]
    caption = (
        f"Planning alone with a model pre-trained for {frames_label(study.pretrain)} frames: at once (zero-shot), and "
        f"{after(study, pretrain=False)}; beside it an actor that had as many frames of the task and nothing before."
    )
    return domain_bars(study, "zero_shot", arms, "Zero-shot against fine-tuned", caption, COLUMN * 1.3)


def _planning_alone(study: Study) -> tuple[Arm, Arm]:
    """MPPI at once, and MPPI after fine-tuning: of one length of pre-training, in the same form of the tasks."""
    same_task = settled(filter(_mppi, study.rows))
    return (
        study.pretrained("zero-shot MPPI", any_task, _mppi, same_task, lambda row: row.finetune_frames == 0, frames=0),
        study.pretrained("fine-tuned MPPI", any_task, _mppi, same_task, lambda row: row.finetune_frames > 0),
    )


def _mppi(row: Row) -> bool:
    return row.planner in (MPPI, "mppi_zero_shot", "zero_shot") and row.pretrain_frames > 0


def _knows(row: Row) -> bool:
    return bool(row["known_reward"] == "true")


def _is_dreamer(row: Row) -> bool:
    return row.method == "dreamer"


def profiles(study: Study, repetitions: int = REPETITIONS) -> Picture | None:
    """Performance profiles (Agarwal et al. 2021): the share of runs above each score, with 95 % bands."""
    found = _shown(study)
    arms = [arm for arm in (one.scored() for one in found) if arm.rows]
    if not arms:
        return None
    study.show(arms)
    figure, [axes] = new_figure(1, COLUMN * 1.3, 2.3)
    thresholds = np.linspace(0, 1.2, 61)
    handles = []
    for i, arm in enumerate(arms):
        scores = arm.scores(study.normalizer)
        share, low, high = performance_profile(scores, thresholds, repetitions)
        label = arm.label if len(scores) == len(TASKS) else f"{arm.label} ({len(scores)} of {len(TASKS)} tasks)"
        color = COLORS[i % len(COLORS)]
        # Where lines cross, colours alone are hard to follow.
        style = STYLES[(i + i // len(COLORS)) % len(STYLES)]
        axes.fill_between(100 * thresholds, 100 * low, 100 * high, color=color, alpha=0.15, lw=0)
        handles += axes.plot(100 * thresholds, 100 * share, color=color, ls=style, label=label, drawstyle="steps-post")
    axes.set(
        xlabel="normalised score τ (%)", ylabel="runs with a score above τ (%)", title="Performance profiles", ylim=(0, 102)
    )
    caption = (
        f"Share of runs above a score, tasks counting alike, {after(study)}. {normalized(study)}; bands: 95 % of a "
        f"bootstrap of the seeds; all {len(TASKS)} tasks where no other number stands; {seeds(arms)}.{unscored(found)}"
    )
    return finish("profiles", figure, caption, study.synthetic, handles, 2)


def discrepancy(study: Study) -> Picture | None:
    """Paper, figure "LDD and performance correlation": column ``ldd`` against the ratio zero-shot / fine-tuned."""
    at_once, tuned = _planning_alone(study)
    varied = ("finetune_frames", "adaptation")
    shot = {row.setting(*varied): row.return_mean for row in at_once.rows}
    tuned = tuned.only(lambda row: row["ldd"] != "" and row.return_mean != 0 and row.setting(*varied) in shot)
    points: dict[str, list[tuple[float, float]]] = {}
    for row in tuned.rows:
        points.setdefault(row.domain, []).append((float(row["ldd"]), shot[row.setting(*varied)] / row.return_mean))
    if not points:
        return None
    study.show([at_once, tuned])
    caption = (
        "Latent dynamics discrepancy in nats (Jensen–Shannon, fine-tuned against pre-trained model) and the ratio of "
        f"zero-shot to fine-tuned return {after(study)}, one point a run, {seeds([tuned])}."
    )
    return scatter(
        "discrepancy", points, "latent dynamics discrepancy (nats)", "zero-shot / fine-tuned", caption, study.synthetic
    )


#: all of them, in the paper's order
FIGURES: tuple[Callable[[Study], Picture | None], ...] = (
    benchmark,
    snapshots_by_category,
    snapshots_by_method,
    longer_pretraining,
    modules,
    planning,
    perturbed,
    known_reward,
    zero_shot,
    discrepancy,
    sparsity,
    profiles,
)
