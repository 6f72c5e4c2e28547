"""From rows to scores: mean ± standard error as the paper gives it, and robust aggregates with bootstrap intervals.

IQM, performance profiles and probability of improvement are those of Agarwal et al., "Deep Reinforcement Learning at the
Edge of the Statistical Precipice" (2021), from their package ``rliable``. Its tables need equally many seeds of every task;
here each task is resampled by itself (``arch``, on which ``rliable`` stands), so that runs may be missing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_dreamer_urlb.evaluation.names import TASKS
from sb3_dreamer_urlb.evaluation.rows import Row
from sb3_dreamer_urlb.evaluation.scores import DREAMER_2M, normalized_score
from sb3_dreamer_urlb.version import how_to_install

MISSING_RLIABLE = f"Interquartile means and intervals need rliable; {how_to_install('plots')}."
#: shares of a budget of frames: the evaluation that counts comes so early at most (a few steps), and so late (an interval)
NEAR, LATE = 0.05, 0.25
REPETITIONS, SIZE = 2000, 0.95

#: ``<domain>-<task>`` → the score (or return) of each seed
Scores = Mapping[str, Sequence[float]]


@dataclass(frozen=True)
class Estimate:
    """A number with what is known of its spread.

    :param value: NaN where there are no runs
    :param low: end of the interval, or value − standard error; NaN if unknown, as of a single seed
    :param high: likewise
    :param tasks: that went into it
    :param seeds: least and most seeds of a task
    """

    value: float
    low: float = math.nan
    high: float = math.nan
    tasks: int = 0
    seeds: tuple[int, int] = (0, 0)

    @property
    def error(self) -> float:
        """Half of the interval: the standard error, where that is the interval."""
        return (self.high - self.low) / 2


NOTHING = Estimate(math.nan)


def final_rows(rows: Iterable[Row], frames: int) -> tuple[list[Row], list[Row]]:
    """The evaluation of every run at a budget of fine-tuning frames (paper §4: the score is the last).

    It is the one nearest to the budget, from 5 % before it to 25 % past it: a run that is evaluated at 90k and 110k frames has
    used up 100k, and what it scored at 110k counts.

    :param rows: of any number of runs
    :param frames: the budget
    :return: one row of each run that has one there, and of those that have none the last row before, or else the first after
    """
    nearest: dict[Any, Row] = {}

    def distance(row: Row) -> tuple[bool, bool, int, bool]:
        off = row.finetune_frames - frames
        there = -NEAR * frames <= off <= LATE * frames
        return not there, off > 0 and not there, abs(off), off < 0

    for row in rows:
        run = row.setting("finetune_frames")
        if run not in nearest or distance(row) < distance(nearest[run]):
            nearest[run] = row
    done = [row for row in nearest.values() if not distance(row)[0]]
    return done, [row for row in nearest.values() if distance(row)[0]]


def scores_of(rows: Iterable[Row], normalizer: str | None = DREAMER_2M) -> dict[str, list[float]]:
    """Scores by task.

    :param rows: one of each run
    :param normalizer: what they are shares of; None leaves returns
    """
    scores: dict[str, list[float]] = {}
    for row in rows:
        task = f"{row.domain}-{row.task}"
        score = row.return_mean if normalizer is None else normalized_score(task, row.return_mean, normalizer)
        scores.setdefault(task, []).append(score)
    return {task: scores[task] for task in sorted(scores, key=_place)}


def of_domain(scores: Scores, domain: str | None) -> dict[str, Sequence[float]]:
    """The tasks of one domain; all of them for None."""
    return {task: values for task, values in scores.items() if domain is None or task.startswith(f"{domain}-")}


def _place(task: str) -> tuple[int, str]:
    return (TASKS.index(task) if task in TASKS else len(TASKS), task)


def standard_error(values: Sequence[float]) -> float:
    """Of the mean of independent values; NaN for fewer than two."""
    return float(np.std(values, ddof=1) / math.sqrt(len(values))) if len(values) > 1 else math.nan


def mean_and_error(scores: Scores) -> Estimate:
    """Mean over tasks of the mean over seeds, ± its standard error.

    The error is that of the seeds, carried through the mean over tasks; tasks are not a sample of anything. (The paper's own
    errors of its twelve tasks give 0.81 % that way, it writes 0.84 %.) NaN where a task has one seed only.

    :param scores: by task
    """
    scores = {task: values for task, values in scores.items() if len(values)}
    if not scores:
        return NOTHING
    value = float(np.mean([np.mean(values) for values in scores.values()]))
    error = combined_error([standard_error(values) for values in scores.values()])
    return Estimate(value, value - error, value + error, *_counts(scores))


def combined_error(errors: Sequence[float]) -> float:
    """Standard error of the mean over tasks, from the tasks' own."""
    return math.sqrt(sum(error**2 for error in errors)) / len(errors)


def _counts(scores: Scores) -> tuple[int, tuple[int, int]]:
    numbers = [len(values) for values in scores.values()]
    return len(numbers), (min(numbers), max(numbers))


# -- robust aggregates -------------------------------------------------------------------------------------------------


def check_rliable_installed() -> None:
    """
    :raises ImportError: if rliable is not installed, naming the extra
    """
    try:
        import arch  # noqa: F401
        import rliable  # noqa: F401
    except ImportError as error:
        raise ImportError(MISSING_RLIABLE) from error


def iqm(scores: Scores, repetitions: int = REPETITIONS, size: float = SIZE, seed: int = 0) -> Estimate:
    """Interquartile mean of all runs, with the interval of a bootstrap that resamples the seeds of each task.

    :param scores: by task
    :param repetitions: of the bootstrap
    :param size: of the interval
    :param seed: of the bootstrap
    :raises ImportError: if rliable is not installed
    """
    check_rliable_installed()
    from rliable import metrics

    def statistic(*tasks: np.ndarray) -> float:
        return float(metrics.aggregate_iqm(np.concatenate(tasks)))

    return _with_interval(scores, statistic, repetitions, size, seed)


def performance_profile(
    scores: Scores, thresholds: Sequence[float] | np.ndarray, repetitions: int = REPETITIONS, size: float = SIZE, seed: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Share of runs whose score is above each threshold, tasks counting alike.

    :param scores: by task
    :param thresholds: to be above of
    :param repetitions: of the bootstrap
    :param size: of the pointwise intervals
    :param seed: of the bootstrap
    :return: share, low and high end of its interval, each of the length of ``thresholds``; NaN where an interval is unknown
    :raises ImportError: if rliable is not installed
    """
    check_rliable_installed()
    above = np.asarray(thresholds)

    def statistic(*tasks: np.ndarray) -> np.ndarray:
        return np.asarray(np.mean([(task[:, None] > above).mean(0) for task in tasks], 0))

    tasks = _arrays(scores)
    share = statistic(*tasks)
    low, high = _interval(tasks, statistic, repetitions, size, seed, len(above))
    return share, low, high


def probability_of_improvement(
    scores: Scores, other: Scores, repetitions: int = REPETITIONS, size: float = SIZE, seed: int = 0
) -> Estimate:
    """How likely a run of one is better than a run of the other on a task drawn at random among those that both have.

    :param scores: by task
    :param other: by task
    :param repetitions: of the bootstrap
    :param size: of the interval
    :param seed: of the bootstrap
    :raises ImportError: if rliable is not installed
    """
    check_rliable_installed()
    common = [task for task in scores if len(scores[task]) and len(other.get(task, ()))]
    if not common:
        return NOTHING

    def statistic(*tasks: np.ndarray) -> float:
        pairs = zip(tasks[: len(common)], tasks[len(common) :], strict=True)
        # What rliable computes by a rank test, a hundred times slower: the share of pairs, ties count half.
        return float(np.mean([np.mean((np.sign(x[:, None] - y) + 1) / 2) for x, y in pairs]))

    both = {f"{i}-{task}": side[task] for i, side in enumerate((scores, other)) for task in common}
    found = _with_interval(both, statistic, repetitions, size, seed)
    return Estimate(found.value, found.low, found.high, len(common), found.seeds)


def _arrays(scores: Scores) -> list[np.ndarray]:
    return [np.asarray(values, float) for values in scores.values() if len(values)]


def _with_interval(scores: Scores, statistic: Callable[..., float], repetitions: int, size: float, seed: int) -> Estimate:
    tasks = _arrays(scores)
    if not tasks:
        return NOTHING
    low, high = _interval(tasks, statistic, repetitions, size, seed, 1)
    counts = _counts({task: values for task, values in scores.items() if len(values)})
    return Estimate(float(statistic(*tasks)), float(low[0]), float(high[0]), *counts)


def _interval(
    tasks: Sequence[np.ndarray], statistic: Callable[..., Any], repetitions: int, size: float, seed: int, length: int
) -> tuple[np.ndarray, np.ndarray]:
    """Percentile interval; NaN where no task has two seeds, as nothing is known of the spread then."""
    if max(map(len, tasks), default=0) < 2:
        return np.full(length, math.nan), np.full(length, math.nan)
    from arch.bootstrap import IndependentSamplesBootstrap

    bootstrap = IndependentSamplesBootstrap(*tasks, seed=np.random.RandomState(seed))
    low, high = bootstrap.conf_int(statistic, repetitions, method="percentile", size=size)
    return np.atleast_1d(low), np.atleast_1d(high)
