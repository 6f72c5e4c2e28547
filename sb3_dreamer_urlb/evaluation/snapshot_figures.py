"""Figures of scores over snapshots of the pre-training. Each function gives None where there is not one run to show."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from sb3_dreamer_urlb.evaluation.aggregate import mean_and_error, of_domain
from sb3_dreamer_urlb.evaluation.arms import Arm, Study, acts, scratch, task_aware
from sb3_dreamer_urlb.evaluation.figure_parts import DOMAINS, is_method, normalized, seeds
from sb3_dreamer_urlb.evaluation.names import CATEGORIES, method
from sb3_dreamer_urlb.evaluation.rows import Row
from sb3_dreamer_urlb.evaluation.style import Picture, finish, frames_label, lines, new_figure


def _over_snapshots(
    study: Study, name: str, groups: Mapping[str, Callable[[Row], bool]], lengths: list[int], title: str
) -> Picture | None:
    def tuned(row: Row) -> bool:
        return row.pretrain_frames > 0 and task_aware(row)

    arms = {label: study.arm(label, acts, tuned, belongs) for label, belongs in groups.items()}
    arms = {label: arm for label, arm in arms.items() if any(row.pretrain_frames in lengths for row in arm.rows)}
    if not arms or len(lengths) < 2:
        return None
    figure, panels = new_figure(4)
    places = {frames: float(i) for i, frames in enumerate(lengths)}
    without = study.arm("no pre-training", scratch, acts, lambda row: row.method == "dreamer")
    handles: list[Any] = []
    for axes, (panel, domain) in zip(panels, DOMAINS.items(), strict=True):
        series = {}
        for label, arm in arms.items():
            at = {n: Arm(label, tuple(row for row in arm.rows if row.pretrain_frames == n)) for n in lengths}
            series[label] = {n: mean_and_error(of_domain(one.scores(study.normalizer), domain)) for n, one in at.items()}
        handles = lines(axes, series, places)
        level = mean_and_error(of_domain(without.scores(study.normalizer), domain)).value
        if not math.isnan(level):
            handles.append(axes.axhline(100 * level, color="#555555", ls=":", lw=1, label=without.label))
        if not any(not math.isnan(one.value) for points in series.values() for one in points.values()):
            axes.text(0.5, 0.5, "no runs", transform=axes.transAxes, ha="center", color="#777777")
        axes.set(title=panel, xlabel="pre-training frames")
        axes.set_xticks(list(places.values()), [frames_label(frames) for frames in places])
        axes.set_xlim(-0.35, len(places) - 0.65)
    panels[0].set_ylabel("normalised score (%)")
    top = max(axes.get_ylim()[1] for axes in panels)
    for axes in panels:
        axes.set_ylim(0, top)
    caption = (
        f"{title}: snapshots of the pre-training, each fine-tuned for {frames_label(study.finetune)} frames, actor alone. "
        f"{normalized(study)}, mean over tasks ± standard error; {seeds(_split(arms.values(), lengths))}."
    )
    return finish(name, figure, caption, study.synthetic, handles, 5)


def _split(arms: Iterable[Arm], lengths: Sequence[int]) -> list[Arm]:
    """One arm for each length of pre-training."""
    parts = [Arm(arm.label, tuple(row for row in arm.rows if row.pretrain_frames == n)) for arm in arms for n in lengths]
    return [part for part in parts if part.rows]


def _lengths(study: Study, low: int, high: float) -> list[int]:
    return sorted({row.pretrain_frames for row in study.done if low <= row.pretrain_frames <= high})


def snapshots_by_method(study: Study) -> Picture | None:
    """Paper, appendix: scores over snapshots of the pre-training, each method a line."""
    groups = {method(name).label: is_method(name) for name in study.methods if name != "disagreement"}
    return _over_snapshots(study, "snapshots_by_method", groups, _lengths(study, 1, 2_000_000), "Methods over pre-training")


def snapshots_by_category(study: Study) -> Picture | None:
    """Paper, figure "Unsupervised pre-training": scores over snapshots, each category of methods a line."""
    groups = {f"{category}-based" if category != "random" else category: _is_category(category) for category in CATEGORIES}
    return _over_snapshots(
        study, "snapshots_by_category", groups, _lengths(study, 1, 2_000_000), "Categories over pre-training"
    )


def longer_pretraining(study: Study) -> Picture | None:
    """Paper, appendix: pre-training of up to 5M frames."""
    lengths = _lengths(study, 1_000_000, math.inf)
    if not any(frames > 2_000_000 for frames in lengths):
        return None
    groups = {method(name).label: is_method(name) for name in study.methods if name != "disagreement"}
    return _over_snapshots(study, "longer_pretraining", groups, lengths, "Pre-training of 1M to 5M frames")


def _is_category(category: str) -> Callable[[Row], bool]:
    return lambda row: method(row.method).category == category and row.method != "disagreement"
