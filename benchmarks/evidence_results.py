"""What the runs of evidence.py say: a table with intervals, how many seeds a difference needs, and a figure.

    python benchmarks/evidence_results.py                    # the table, as Markdown
    python benchmarks/evidence_results.py --figure out.png   # learning curves, too

Interquartile means over seeds with 95 % bootstrap intervals. The episodes of results/evidence/episodes.csv give the mean
return over all of fine-tuning (the area under its curve) and over its last quarter; rows.csv gives the evaluations at its
end, actor alone and with Dyna-MPC.
"""

from __future__ import annotations

import argparse
import itertools
import math
from collections.abc import Sequence
from pathlib import Path

import evidence_study as study
import numpy as np

from sb3_dreamer_urlb.evaluation.aggregate import iqm
from sb3_dreamer_urlb.evaluation.rows import Row, read_rows
from sb3_dreamer_urlb.evaluation.style import COLORS, frames_label, new_figure
from sb3_dreamer_urlb.output_reader import ending_with_its_reader

MEASURES = ("whole", "last quarter", "end, actor", "end, Dyna-MPC")
LABELS = {
    "scratch": "from scratch",
    "lbs-kept": "LBS, actor kept",
    "lbs-fresh": "LBS, fresh actor",
    "random-fresh": "random actions, fresh actor",
    "plan2explore-kept": "Plan2Explore, actor kept",
    "plan2explore-fresh": "Plan2Explore, fresh actor",
    **{
        f"lbs-kept-{name}": f"LBS, actor kept, {changed}"
        for name, changed in {
            "target-2": "target critic every 2 updates",
            "target-50": "target critic every 50 updates",
            "rate-2e-4": "model's rate 2e-4",
            "start-2500": "updates from step 2500 on",
        }.items()
    },
}
#: of a normal distribution: two-sided 5 % error, 80 % power
_QUANTILES = 1.96 + 0.84
#: of the bootstrap, at each episode
FIGURE_REPETITIONS = 300

#: task → arm → measure → one number a seed
Scores = dict[str, dict[str, dict[str, list[float]]]]


def training_returns() -> dict[str, dict[str, list[list[float]]]]:
    """Task → arm → of each finished run, the returns of its episodes in their order."""
    found: dict[str, dict[str, list[list[float]]]] = {}
    for name, episodes in study.curves().items():
        task, arm, _ = name.split("/")
        if "pretraining" not in task:
            found.setdefault(task, {}).setdefault(arm, []).append([value for _, value in sorted(episodes)])
    return found


def scores() -> Scores:
    """Of all finished runs."""
    found: Scores = {}

    def add(task: str, arm: str, measure: str, value: float) -> None:
        found.setdefault(task, {}).setdefault(arm, {name: [] for name in MEASURES})[measure].append(value)

    for task, arms in training_returns().items():
        for arm, returns in ((arm, one) for arm, runs in arms.items() for one in runs):
            add(task, arm, "whole", float(np.mean(returns)))
            add(task, arm, "last quarter", float(np.mean(returns[-max(len(returns) // 4, 1) :])))
    for row in read_rows(study.ROOT / "rows.csv", tasks=("finger-spin",)).rows:
        add(task_of(row), row.further["arm"], f"end, {'actor' if row.planner == 'none' else 'Dyna-MPC'}", row.return_mean)
    return found


def task_of(row: Row) -> str:
    """As runs are named: a task, after the name of the setting unless that is states."""
    sizes = {(setting.observation, setting.preset): size for size, setting in study.SETTINGS.items()}
    return study.prefix(sizes.get((row.further.get("observation", ""), row.preset), "state")) + row.task


def seeds_needed(one: Sequence[float], other: Sequence[float]) -> int:
    """An arm, so that a difference as large as the one seen is found at 5 % in four of five studies: two normal samples of the
    spread that was seen.
    """
    variance = (np.var(one, ddof=1) + np.var(other, ddof=1)) / 2
    difference = np.mean(one) - np.mean(other)
    return max(2, math.ceil(2 * variance * (_QUANTILES / difference) ** 2)) if difference else 10**9


def table(found: Scores) -> str:
    """A line for every task and arm."""
    lines = [f"| task | agent | seeds | {' | '.join(MEASURES)} |", "|---|---|---|" + "---|" * len(MEASURES)]
    for task, arm in itertools.product(found, LABELS):
        values = found[task].get(arm, {})
        count = len(values.get("whole", ()))
        if count < 2:
            continue
        cells = []
        for measure in MEASURES:
            found_here = iqm({task: values[measure]})
            cells.append(f"{found_here.value:.0f} [{found_here.low:.0f}, {found_here.high:.0f}]")
        lines.append(f"| {task} | {LABELS[arm]} | {count} | {' | '.join(cells)} |")
    return "\n".join(lines)


def needed(found: Scores) -> str:
    """How many seeds an arm each difference from scratch needs."""
    lines = [f"| task | against scratch | {' | '.join(MEASURES)} |", "|---|---|" + "---|" * len(MEASURES)]
    for task, arm in itertools.product(found, LABELS):
        mine, base = found[task].get(arm), found[task].get("scratch")
        if arm == "scratch" or mine is None or base is None or min(len(mine["whole"]), len(base["whole"])) < 2:
            continue
        cells = []
        for name in MEASURES:
            difference = np.mean(mine[name]) - np.mean(base[name])
            cells.append(f"{difference:+.0f}: {seeds_needed(mine[name], base[name])}")
        lines.append(f"| {task} | {LABELS[arm]} | {' | '.join(cells)} |")
    return "\n".join(lines)


def parts(by_run: dict[str, list[tuple[int, float]]]) -> str:
    """What a world model of random data gives, what one of LBS's, and what its actor adds, over the seeds that all have.

    :param by_run: name of a run → agent step and return of its episodes
    """
    steps = ("scratch", "random-fresh", "lbs-fresh", "lbs-kept")
    lines = [
        f"| task | seeds | {' | '.join(LABELS[arm] for arm in steps)} | actor kept, by quarter |",
        "|---|---|" + "---|" * 5,
    ]
    for task in sorted({name.split("/")[0] for name in by_run}):
        seeds = set.intersection(
            *({name.split("/")[2] for name in by_run if name.startswith(f"{task}/{arm}/")} for arm in steps)
        )
        if len(seeds) < 2:
            continue
        size = next((size for size in study.SETTINGS if size != "state" and task.startswith(study.prefix(size))), "state")
        runs = {arm: [by_run[f"{task}/{arm}/{seed}"] for seed in sorted(seeds)] for arm in steps}
        means = [np.mean([np.mean([value for _, value in run]) for run in runs[arm]]) for arm in steps]
        with_actor, without = (
            np.mean([quarters(run, study.SETTINGS[size].finetuning) for run in runs[arm]], 0)
            for arm in ("lbs-kept", "lbs-fresh")
        )
        cells = [*(f"{value:.0f}" for value in means), ", ".join(f"{value:+.0f}" for value in with_actor - without)]
        lines.append(f"| {task} | {len(seeds)} | {' | '.join(cells)} |")
    return "\n".join(lines)


def quarters(run: list[tuple[int, float]], steps: int) -> list[float]:
    """Mean return in each quarter of a fine-tuning.

    :param run: agent step and return of its episodes
    :param steps: agent steps of it all
    """
    return [float(np.mean([value for step, value in run if i < 4 * step / steps <= i + 1])) for i in range(4)]


def draw(path: Path, size: str = "state") -> None:
    """Returns of the training episodes over frames, interquartile mean and interval over seeds, a panel a task.

    :param path: of the PNG
    :param size: the setting whose tasks are drawn
    :raises ValueError: if it has no two runs of an agent yet
    """
    import matplotlib.pyplot as plt

    # An interval takes two runs at least.
    enough = {task: arms for task, arms in training_returns().items() if max(map(len, arms.values())) > 1}
    wanted = dict.fromkeys(task for _, tasks, _ in study.STUDY[size] for task in tasks)
    tasks = [task for task in wanted if study.prefix(size) + task in enough]
    if not tasks:
        raise ValueError(f"An interval takes two runs of an agent at least, and the setting {size!r} has none yet.")
    figure, panels = new_figure(len(tasks), 3.4 * len(tasks), 3.3)
    for axes, task in zip(panels, tasks, strict=True):
        arms = enough[study.prefix(size) + task]
        for i, (arm, label) in enumerate(LABELS.items()):
            runs = arms.get(arm, [])
            if len(runs) < 2 or study.ARMS[arm].changes:
                continue
            length = min(map(len, runs))
            points = [iqm({task: [run[at] for run in runs]}, FIGURE_REPETITIONS) for at in range(length)]
            middle, low, high = np.array([(point.value, point.low, point.high) for point in points]).T
            frames = study.REPEAT * study.EPISODE * np.arange(1, length + 1)
            axes.plot(frames, middle, color=COLORS[i], label=f"{label} ({len(runs)})")
            axes.fill_between(frames, low, high, color=COLORS[i], alpha=0.2, lw=0)
        axes.set(title=f"{study.BODIES.get(task, 'walker')} {task}", xlabel="environment frames of the task", ylim=(0, None))
        axes.xaxis.set_major_formatter(lambda value, _: frames_label(round(value)))
        # Below: curves that rise leave no corner of their panel free.
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.22), title="agent (seeds)", title_fontsize=7)
    panels[0].set_ylabel("return of a training episode")
    figure.tight_layout()
    figure.savefig(path, dpi=160, bbox_inches="tight", pad_inches=0.05)
    plt.close(figure)


@ending_with_its_reader()
def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--figure", type=Path, help="PNG to draw the learning curves into")
    parser.add_argument("--setting", choices=sorted(study.STUDY), default="state", help="whose curves (default: state)")
    options = parser.parse_args()
    found = scores()
    print(f"{table(found)}\n\nDifference from scratch, and seeds an arm that it needs:\n\n{needed(found)}")
    print(f"\nWhich part helps: mean return over the seeds that all four have:\n\n{parts(study.curves())}")
    if options.figure is not None:
        draw(options.figure, options.setting)


if __name__ == "__main__":
    main()
