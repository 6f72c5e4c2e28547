"""The paper's figures, from rows. Each function gives None where there is not one run to show."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from sb3_dreamer_urlb.envs.registration import URLB_TASKS
from sb3_dreamer_urlb.evaluation.aggregate import REPETITIONS, Estimate, mean_and_error, of_domain, performance_profile
from sb3_dreamer_urlb.evaluation.arms import MPPI, Arm, Study, acts, any_task, kept, plans, scratch, task_aware
from sb3_dreamer_urlb.evaluation.names import CATEGORIES, LEVELS, method
from sb3_dreamer_urlb.evaluation.rows import Row
from sb3_dreamer_urlb.evaluation.scores import URLB_EXPERT
from sb3_dreamer_urlb.evaluation.style import (
    COLORS,
    COLUMN,
    MARKERS,
    PAGE,
    Picture,
    bars,
    finish,
    frames_label,
    lines,
    new_figure,
)

OVERALL = "overall"
DOMAINS: dict[str, str | None] = {OVERALL: None, **{domain: domain for domain in URLB_TASKS}}
TASKS_OF = {OVERALL: 12, **dict.fromkeys(URLB_TASKS, 4)}
REFERENCE_NAMES = {URLB_EXPERT: "the URLB expert"}


def _normalized(study: Study) -> str:
    return f"Normalised score in % of {REFERENCE_NAMES.get(study.normalizer, 'Dreamer@2M')}"


def _seeds(arms: Sequence[Arm]) -> str:
    """How many seeds a method has of a task, over all arms."""
    numbers = [count for arm in arms for count in Counter((row.method, row.domain, row.task) for row in arm.rows).values()]
    if not numbers:
        return "no runs"
    low, high = min(numbers), max(numbers)
    return f"{low} seed{'s' if low > 1 else ''} a task" if low == high else f"{low} to {high} seeds a task"


def _after(study: Study, pretrain: bool = True) -> str:
    before = f"{frames_label(study.pretrain)} frames of pre-training and " if pretrain and study.pretrain else ""
    return f"after {before}{frames_label(study.finetune)} frames of fine-tuning"


def _by_domain(study: Study, arm: Arm) -> list[Estimate]:
    scores = arm.scores(study.normalizer)
    return [mean_and_error(of_domain(scores, domain)) for domain in DOMAINS.values()]


def _domain_bars(
    study: Study, name: str, arms: Sequence[Arm], title: str, caption: str, width: float = PAGE
) -> Picture | None:
    if not any(arm.rows for arm in arms):
        return None
    figure, [axes] = new_figure(1, width)
    series = {arm.label: _by_domain(study, arm) for arm in arms}
    handles = bars(axes, list(DOMAINS), series, list(TASKS_OF.values()))
    axes.set(ylabel="normalised score (%)", title=title)
    text = f"{caption} {_normalized(study)}, mean over tasks ± standard error; {_seeds([arm for arm in arms if arm.rows])}."
    return finish(name, figure, text, study.synthetic, handles, 4 if width > COLUMN else 2)


def benchmark(study: Study) -> Picture | None:
    """Paper, figure "URL Benchmark": every approach by domain."""
    arms = study.approaches()
    # Of other methods than the paper's figure has, the full one is enough: all of them stand in the table.
    full = [arm for arm in arms if "+" not in arm.label or arm.label.startswith("P2E") or arm.label.endswith("Dyna-MPC")]
    if len(arms) > len(COLORS):
        bare = {method(name).label for name in study.methods} - {"Disagreement", "P2E"}
        arms = [arm for arm in full if arm.label not in bare]
    return _domain_bars(study, "benchmark", arms, "URL benchmark", f"Approaches {_after(study)}.")


def modules(study: Study) -> Picture | None:
    """Paper, figure "Task-aware fine-tuning": which pre-trained modules are kept, over all methods."""
    arms = [
        study.pretrained("model", acts, kept(False, False)),
        study.pretrained("model + actor", acts, kept(True, False)),
        study.pretrained("model + actor + critic", acts, kept(True, True)),
    ]
    caption = f"Pre-trained modules that fine-tuning starts from, {_after(study)}; all exploration methods together."
    return _domain_bars(study, "modules", arms, "Module ablation", caption, COLUMN * 1.3)


def planning(study: Study) -> Picture | None:
    """Paper, figure "Dyna-MPC": fine-tuning with and without the planner, over all methods."""
    arms = [study.pretrained("actor alone", acts, task_aware), study.pretrained("Dyna-MPC", plans, task_aware)]
    if not all(arm.rows for arm in arms):
        return None
    # The same methods on both sides, or the comparison is one of methods.
    both = set.intersection(*({row.method for row in arm.rows} for arm in arms))
    arms = [Arm(arm.label, tuple(row for row in arm.rows if row.method in both)) for arm in arms]
    names = ", ".join(method(name).label for name in study.methods if name in both)
    caption = f"Fine-tuning with and without Dyna-MPC {_after(study)}; {names}."
    return _domain_bars(study, "planning", arms, "Dyna-MPC", caption, COLUMN * 1.3)


def known_reward(study: Study) -> Picture | None:
    """Paper, figure "reward ablation": the reward is learnt in fine-tuning, or known from pre-training on."""

    def knows(row: Row) -> bool:
        return row["known_reward"] == "true" and not (row["perturbation"])

    known = study.pretrained("reward known", any_task, knows)
    if not known.rows:
        return None

    def setting(row: Row) -> tuple[Any, ...]:
        return row.method, row.domain, row.task, row.planner, row["variant"], row.keep_actor, row.keep_critic

    # Like with like: settings that were run with the reward known.
    same = {setting(row) for row in known.rows}
    unknown = study.pretrained(
        "reward learnt while fine-tuning",
        any_task,
        lambda row: row["known_reward"] != "true" and not row["perturbation"] and setting(row) in same,
    )
    caption = f"Reward predictor from pre-training on, or from scratch, {_after(study)}."
    return _domain_bars(study, "known_reward", [unknown, known], "Known reward", caption, COLUMN * 1.3)


def zero_shot(study: Study) -> Picture | None:
    """Paper, figure "Zero-shot (ZS) vs fine-tuned (FT)": planning with the pre-trained model, and after fine-tuning."""
    arms = [
        Arm("DreamerV2, no pre-training", study.arm("", scratch, acts, lambda row: row.method == "dreamer").rows),
        study.arm("zero-shot MPPI", any_task, _mppi, lambda row: row.finetune_frames == 0, frames=0),
        study.pretrained("fine-tuned MPPI", any_task, _mppi, lambda row: row.finetune_frames > 0),
    ]
    if not any(arm.rows for arm in arms[1:]):
        return None
    caption = f"Planning alone, with no frames of the task and {_after(study)}."
    return _domain_bars(study, "zero_shot", arms, "Zero-shot against fine-tuned", caption, COLUMN * 1.3)


def _mppi(row: Row) -> bool:
    return row.planner in (MPPI, "mppi_zero_shot", "zero_shot") and row.pretrain_frames > 0


# -- over snapshots ----------------------------------------------------------------------------------------------------


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
        f"{_normalized(study)}, mean over tasks ± standard error; {_seeds(_split(arms.values(), lengths))}."
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
    groups = {method(name).label: _is_method(name) for name in study.methods if name != "disagreement"}
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
    groups = {method(name).label: _is_method(name) for name in study.methods if name != "disagreement"}
    return _over_snapshots(study, "longer_pretraining", groups, lengths, "Pre-training of 1M to 5M frames")


def _is_method(name: str) -> Callable[[Row], bool]:
    return lambda row: row.method == name


def _is_category(category: str) -> Callable[[Row], bool]:
    return lambda row: method(row.method).category == category and row.method != "disagreement"


# -- changed tasks -----------------------------------------------------------------------------------------------------


def perturbed(study: Study) -> Picture | None:
    """Paper, figure "RWRL tasks": fine-tuning in perturbed environments."""
    rows = [row for row in study.rows if row["perturbation"] in LEVELS]
    if not rows:
        return None
    tasks = sorted({(row.domain, row.task) for row in rows}, key=lambda one: (one[0] != "walker", one))

    def changed(row: Row) -> bool:
        return row["perturbation"] in LEVELS

    arms = [
        study.arm(f"DreamerV2@{frames_label(n)}", any_task, changed, scratch, lambda row: row.method == "dreamer", frames=n)
        for n in (study.finetune, 1_000_000, 2_000_000)
    ]
    for name in study.methods:
        # As it was run: with the planner where there is one.
        for label, planner in ((method(name).label, acts), (f"{method(name).label} + Dyna-MPC", plans)):
            arms.append(study.pretrained(label, any_task, changed, planner, _is_method(name)))
    arms = [arm for arm in arms if arm.rows]
    figure, panels = new_figure(len(tasks), PAGE if len(tasks) > 1 else COLUMN * 1.3)
    handles: list[Any] = []
    for axes, (domain, task) in zip(panels, tasks, strict=True):
        series = {arm.label: [_return_at(arm, domain, task, "perturbation", level) for level in LEVELS] for arm in arms}
        handles = bars(axes, LEVELS, series, [1] * 3, scale=1)
        axes.set(title=f"{domain} {task}", ylabel="return")
    caption = (
        f"Tasks with the perturbations of the Real-World RL suite, {_after(study)} (pre-training without perturbations). "
        f"Undiscounted return, mean over seeds ± standard error; {_seeds(_by(arms, 'perturbation'))}."
    )
    return finish("perturbed", figure, caption, study.synthetic, handles)


def _return_at(arm: Arm, domain: str, task: str, column: str, value: str) -> Estimate:
    rows = tuple(row for row in arm.rows if (row.domain, row.task, row[column]) == (domain, task, value))
    return mean_and_error(Arm(arm.label, rows).scores(None))


def _by(arms: Sequence[Arm], column: str) -> list[Arm]:
    values = {row[column] for arm in arms for row in arm.rows}
    parts = [Arm(arm.label, tuple(row for row in arm.rows if row[column] == value)) for arm in arms for value in values]
    return [part for part in parts if part.rows]


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
        f"Jaco reaching with a smaller and a larger rewarded area, {_after(study)}; all methods together. "
        f"{_normalized(study)}, mean over tasks ± standard error; {_seeds(_by(arms, 'variant'))}."
    )
    return finish("sparsity", figure, caption, study.synthetic, handles)


def _jaco(row: Row) -> bool:
    return row.domain == "jaco" and row["perturbation"] == "" and row["variant"] != "fixed"


# -- profiles and correlations -----------------------------------------------------------------------------------------


def profiles(study: Study, repetitions: int = REPETITIONS) -> Picture | None:
    """Performance profiles (Agarwal et al. 2021): the share of runs above each score, with 95 % bands."""
    arms = [arm for arm in study.approaches() if arm.scores(study.normalizer)]
    if not arms:
        return None
    figure, [axes] = new_figure(1, COLUMN * 1.3, 2.3)
    thresholds = np.linspace(0, 1.2, 61)
    handles = []
    for i, arm in enumerate(arms):
        share, low, high = performance_profile(arm.scores(study.normalizer), thresholds, repetitions)
        color = COLORS[i % len(COLORS)]
        style = ("-", "--", "-.", ":")[i // len(COLORS) % 4]
        axes.fill_between(100 * thresholds, 100 * low, 100 * high, color=color, alpha=0.15, lw=0)
        handles += axes.plot(100 * thresholds, 100 * share, color=color, ls=style, label=arm.label, drawstyle="steps-post")
    axes.set(
        xlabel="normalised score τ (%)", ylabel="runs with a score above τ (%)", title="Performance profiles", ylim=(0, 102)
    )
    caption = (
        f"Share of runs above a score, tasks counting alike, {_after(study)}. {_normalized(study)}; bands: 95 % of a "
        f"bootstrap of the seeds; {_seeds(arms)}."
    )
    return finish("profiles", figure, caption, study.synthetic, handles, 2)


def discrepancy(study: Study) -> Picture | None:
    """Paper, figure "LDD and performance correlation": column ``ldd`` against the ratio zero-shot / fine-tuned."""
    tuned = study.pretrained("", any_task, lambda row: row["ldd"] != "" and row.finetune_frames > 0)
    shot = {
        (row.method, row.domain, row.task, row.seed): row.return_mean
        for row in study.arm("", any_task, _mppi, lambda row: row.finetune_frames == 0, frames=0).rows
    }
    points: dict[str, list[tuple[float, float]]] = {}
    for row in tuned.rows:
        key = (row.method, row.domain, row.task, row.seed)
        if key in shot and row.return_mean:
            points.setdefault(row.domain, []).append((float(row["ldd"]), shot[key] / row.return_mean))
    if not points:
        return None
    caption = (
        "Latent dynamics discrepancy in nats (Jensen–Shannon, fine-tuned against pre-trained model) and the ratio of "
        "zero-shot to fine-tuned return, one point a run. Line and band: linear fit and the 95 % interval of its mean."
    )
    return scatter(
        "discrepancy", points, "latent dynamics discrepancy (nats)", "zero-shot / fine-tuned", caption, study.synthetic
    )


def scatter(
    name: str, points: Mapping[str, Sequence[tuple[float, float]]], x: str, y: str, caption: str, synthetic: bool
) -> Picture:
    """Points by group, with a linear fit, its interval, Pearson's r and p.

    :param name: of the files
    :param points: group → (x, y)
    :param x: label
    :param y: label
    :param caption: what is shown; r, p and the number of points are added
    :param synthetic: mark as made up
    """
    figure, [axes] = new_figure(1, COLUMN * 1.3, 2.3)
    handles = []
    for i, (label, found) in enumerate(points.items()):
        xs, ys = zip(*found, strict=True)
        handles.append(axes.scatter(xs, ys, s=18, color=COLORS[i % 10], marker=MARKERS[i % 10], label=label, zorder=3))
    pooled = np.array([point for found in points.values() for point in found])
    r, p = correlation(pooled[:, 0], pooled[:, 1])
    if len(pooled) > 2 and not math.isnan(r):
        at = np.linspace(pooled[:, 0].min(), pooled[:, 0].max(), 50)
        middle, half = _fit(pooled[:, 0], pooled[:, 1], at)
        axes.plot(at, middle, color="#333333", lw=1.2)
        axes.fill_between(at, middle - half, middle + half, color="#333333", alpha=0.15, lw=0)
        axes.set_title(f"r = {r:.2f}, p = {p:.2g}")
    axes.set(xlabel=x, ylabel=y)
    text = f"{caption} Pearson's r = {r:.2f}, p = {p:.2g}, {len(pooled)} points."
    return finish(name, figure, text, synthetic, handles, 3)


def correlation(x: Sequence[float] | np.ndarray, y: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """Pearson's r and its two-sided p; NaN for fewer than three points or where one side does not vary."""
    from scipy import stats

    if len(x) < 3 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return math.nan, math.nan
    found = stats.pearsonr(x, y)
    return float(found.statistic), float(found.pvalue)


def _fit(x: np.ndarray, y: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Linear regression: its mean at some places, and half of its 95 % interval there."""
    from scipy import stats

    fit = stats.linregress(x, y)
    rest = y - fit.intercept - fit.slope * x
    sigma = math.sqrt(float(rest @ rest) / (len(x) - 2))
    spread = float(np.sum((x - x.mean()) ** 2))
    half = stats.t.ppf(0.975, len(x) - 2) * sigma * np.sqrt(1 / len(x) + (at - x.mean()) ** 2 / spread)
    return fit.intercept + fit.slope * at, half


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
