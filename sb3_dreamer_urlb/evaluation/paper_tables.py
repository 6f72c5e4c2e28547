"""The paper's tables, from rows."""

from __future__ import annotations

import math
from collections.abc import Callable

from sb3_dreamer_urlb.evaluation.aggregate import (
    REPETITIONS,
    iqm,
    mean_and_error,
    of_domain,
    probability_of_improvement,
)
from sb3_dreamer_urlb.evaluation.arms import Study, acts, task_aware
from sb3_dreamer_urlb.evaluation.figure_parts import DOMAINS, OVERALL
from sb3_dreamer_urlb.evaluation.names import TASKS, method
from sb3_dreamer_urlb.evaluation.rows import Row
from sb3_dreamer_urlb.evaluation.scatter import correlation
from sb3_dreamer_urlb.evaluation.scores import NORMALIZERS, published_returns, published_scores
from sb3_dreamer_urlb.evaluation.style import frames_label
from sb3_dreamer_urlb.evaluation.tables import MISSING, Table, percent, seeds, with_error, with_interval

#: our label → the paper's
PAPER_S = {"LBS + Dyna-MPC": "Ours"}


def summary(study: Study, repetitions: int = REPETITIONS) -> Table:
    """Paper, table "Mastering URLB from pixels": normalised score of every approach, by domain and overall.

    :param study: the rows
    :param repetitions: of the bootstrap, 0 leaves the interquartile mean out
    """
    robust = ["IQM [95 %]"] if repetitions else []
    table = Table(
        "summary",
        f"Normalised score in % of {'Dreamer@2M' if study.normalizer == 'dreamer_2m' else 'the URLB expert'} after "
        f"{frames_label(study.finetune)} frames of fine-tuning: mean over tasks ± standard error of the seeds, interquartile "
        f"mean with its 95 % bootstrap interval, and what the paper published.",
        [
            "Approach",
            "PT frames",
            *(domain for domain in DOMAINS if domain != OVERALL),
            OVERALL,
            *robust,
            "tasks",
            "seeds",
            "paper",
        ],
    )
    stated = published_scores()
    for arm in study.approaches():
        scored = arm.scored()
        study.show([scored])
        scores = arm.scores(study.normalizer)
        overall = mean_and_error(scores)
        paper_s = stated.get(PAPER_S.get(arm.label, arm.label))
        table.lines.append(
            [
                arm.label,
                "/".join(sorted({frames_label(row.pretrain_frames) for row in (scored.rows or arm.rows)})),
                *(percent(mean_and_error(of_domain(scores, domain))) for domain in list(DOMAINS.values())[1:]),
                percent(overall),
                *([with_interval(iqm(scores, repetitions))] if repetitions else []),
                f"{overall.tasks} of {len(TASKS)}",
                seeds(overall),
                MISSING if paper_s is None else f"{paper_s.mean:.1f} ± {paper_s.error:.1f}",
            ]
        )
    return table


def raw_scores(study: Study) -> Table:
    """Paper, appendix A: return of every task, beside the published references."""
    arms = study.approaches()
    study.show(arms)
    table = Table(
        "raw_scores",
        f"Undiscounted return after {frames_label(study.finetune)} frames of fine-tuning, mean ± standard error of the seeds; "
        "columns in brackets: as the paper published them (pre-training for 2M frames).",
        ["Task", *(arm.label for arm in arms), "(URLB expert)", "(Disagreement)", "(Dreamer@2M)", "(Ours)"],
    )
    others = sorted({f"{row.domain}-{row.task}" for arm in arms for row in arm.rows} - set(TASKS))
    by_arm = [arm.scores(None) for arm in arms]
    disagreement, ours = published_returns("disagreement"), published_returns("ours")
    for task in (*TASKS, *others):
        cells = [with_error(mean_and_error({task: scores[task]})) if task in scores else MISSING for scores in by_arm]
        stated = [MISSING] * 4
        if task in TASKS:
            stated = [
                f"{NORMALIZERS['urlb_expert'][task]:.0f}",
                f"{disagreement[task].mean:.0f} ± {disagreement[task].error:.0f}",
                f"{NORMALIZERS['dreamer_2m'][task]:.0f}",
                f"{ours[task].mean:.0f} ± {ours[task].error:.0f}",
            ]
        table.lines.append([task, *cells, *stated])
    return table


def improvement(study: Study, repetitions: int = REPETITIONS) -> Table:
    """How likely the best approach beats each other one (Agarwal et al. 2021)."""
    arms = [(arm.label, arm.scores(study.normalizer)) for arm in study.approaches()]
    arms = [(label, scores) for label, scores in arms if scores]
    best, scores = max(arms, key=lambda arm: mean_and_error(arm[1]).value)
    table = Table(
        "improvement",
        f"Probability in % that a run of {best} beats a run of the other approach on the same task, tasks counting alike, "
        "with its 95 % bootstrap interval.",
        [f"{best} against", "P [95 %]", "tasks"],
    )
    for label, other in arms:
        if label != best:
            found = probability_of_improvement(scores, other, repetitions)
            table.lines.append([label, with_interval(found), str(found.tasks)])
    return table


def reward_correlation(study: Study) -> Table | None:
    """Paper, table "Pearson correlation": score over tasks against the intrinsic reward of an oracle's trajectories.

    The column ``intrinsic_reward`` of rows with the actor alone.
    """
    table = Table(
        "correlation",
        f"Pearson's r between normalised score after {frames_label(study.finetune)} frames of fine-tuning and mean intrinsic "
        "reward on an oracle's trajectories, over tasks (means of the seeds), with its two-sided p.",
        ["Method", "r", "p", "tasks"],
    )
    for name in study.methods:
        arm = study.pretrained("", acts, task_aware, _measured(name))
        study.show([arm.scored()])
        scores = arm.scores(study.normalizer)
        rewards: dict[str, list[float]] = {}
        for row in arm.rows:
            rewards.setdefault(f"{row.domain}-{row.task}", []).append(float(row["intrinsic_reward"]))
        tasks = [task for task in scores if task in rewards]
        if not tasks:
            continue
        x, y = ([sum(values[task]) / len(values[task]) for task in tasks] for values in (rewards, scores))
        r, p = correlation(x, y)
        known = not math.isnan(r)
        table.lines.append(
            [method(name).label, f"{r:.2f}" if known else MISSING, f"{p:.2g}" if known else MISSING, str(len(tasks))]
        )
    return table if table.lines else None


def _measured(name: str) -> Callable[[Row], bool]:
    return lambda row: row.method == name and row["intrinsic_reward"] != ""
