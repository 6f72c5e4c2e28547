"""Figures of scores over snapshots of the pre-training. Each function gives None where there is not one run to show."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from sb3_dreamer_urlb.evaluation.aggregate import mean_and_error, of_domain
from sb3_dreamer_urlb.evaluation.arms import Arm, Study, acts, plans, scratch, task_aware
from sb3_dreamer_urlb.evaluation.figure_parts import DOMAINS, is_method, normalized, seeds, unscored
from sb3_dreamer_urlb.evaluation.names import CATEGORIES, method
from sb3_dreamer_urlb.evaluation.rows import Row
from sb3_dreamer_urlb.evaluation.style import Picture, finish, frames_label, lines, new_figure

#: lengths of the paper's pre-trainings; small studies have others, between the first and the last
EXPECTED = (1, 100_000, 500_000, 1_000_000, 2_000_000)
LONGER = (1_000_000, 2_000_000, 3_000_000, 4_000_000, 5_000_000)


def _over_snapshots(
    study: Study,
    name: str,
    groups: Mapping[str, Callable[[Row], bool]],
    title: str,
    expected: Sequence[int],
    acting: Callable[[Row], bool] = acts,
    true_to_scale: bool = False,
) -> Picture | None:
    """
    :param study: the rows
    :param name: of the figure
    :param groups: label → whose rows a line is made of
    :param title: of the caption
    :param expected: lengths of pre-training that leave a gap where no run has them; the first is the shortest that is drawn
    :param acting: whether with the planner
    :param true_to_scale: place the lengths as far apart as they are
    """

    def tuned(row: Row) -> bool:
        return expected[0] <= row.pretrain_frames <= (math.inf if true_to_scale else expected[-1]) and task_aware(row)

    found = {label: study.arm(label, acting, tuned, belongs) for label, belongs in groups.items()}
    arms = {label: arm.scored() for label, arm in found.items() if arm.scored().rows}
    present = {row.pretrain_frames for arm in arms.values() for row in arm.rows}
    if len(present) < 2:
        return None
    lengths = sorted({*present, *(frames for frames in expected if min(present) < frames < max(present))})
    figure, panels = new_figure(4)
    places = {frames: frames / lengths[0] if true_to_scale else float(i) for i, frames in enumerate(lengths)}
    without = study.arm("no pre-training", scratch, acts, lambda row: row.method == "dreamer")
    study.show([*arms.values(), without])
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
        else:
            for frames in sorted({*lengths} - present):
                axes.text(places[frames], 0.02, "no runs", transform=axes.get_xaxis_transform(), rotation=90, ha="center",
                          va="bottom", fontsize=6, color="#777777")  # fmt: skip
        axes.set(title=panel, xlabel="pre-training frames")
        axes.set_xticks(list(places.values()), [frames_label(frames) for frames in places])
        axes.set_xlim(min(places.values()) - 0.35, max(places.values()) + 0.35)
    panels[0].set_ylabel("normalised score (%)")
    top = max(axes.get_ylim()[1] for axes in panels)
    for axes in panels:
        axes.set_ylim(0, top)
    who = "actor alone" if acting is acts else "with Dyna-MPC"
    caption = (
        f"{title}: snapshots of the pre-training, each fine-tuned for {frames_label(study.finetune)} frames, {who}. "
        f"{normalized(study)}, mean over tasks ± standard error; {seeds(_split(arms.values(), lengths))}."
        f"{unscored(list(found.values()))}"
    )
    return finish(name, figure, caption, study.synthetic, handles, 5)


def _split(arms: Iterable[Arm], lengths: Sequence[int]) -> list[Arm]:
    """One arm for each length of pre-training."""
    parts = [Arm(arm.label, tuple(row for row in arm.rows if row.pretrain_frames == n)) for arm in arms for n in lengths]
    return [part for part in parts if part.rows]


def snapshots_by_method(study: Study) -> Picture | None:
    """Paper, appendix: scores over snapshots of the pre-training, each method a line."""
    groups = {method(name).label: is_method(name) for name in study.methods if name != "disagreement"}
    return _over_snapshots(study, "snapshots_by_method", groups, "Methods over pre-training", EXPECTED)


def snapshots_by_category(study: Study) -> Picture | None:
    """Paper, figure "Unsupervised pre-training": scores over snapshots, each category of methods a line."""
    groups = {f"{category}-based" if category != "random" else category: _is_category(category) for category in CATEGORIES}
    return _over_snapshots(study, "snapshots_by_category", groups, "Categories over pre-training", EXPECTED)


def longer_pretraining(study: Study) -> Picture | None:
    """Paper, appendix: pre-training of up to 5M frames, with the full method."""
    if not any(row.pretrain_frames > EXPECTED[-1] and plans(row) for row in study.done):
        return None
    groups = {method(name).label: is_method(name) for name in study.methods if name != "disagreement"}
    title = "Pre-training of 1M to 5M frames"
    return _over_snapshots(study, "longer_pretraining", groups, title, LONGER, plans, true_to_scale=True)


def _is_category(category: str) -> Callable[[Row], bool]:
    return lambda row: method(row.method).category == category and row.method != "disagreement"
