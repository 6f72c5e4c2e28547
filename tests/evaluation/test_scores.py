"""Scores: the paper's own rows, small cases by hand, and robust aggregates against independent computations."""

from __future__ import annotations

import math
import re
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rliable import library, metrics

from sb3_dreamer_urlb.evaluation import aggregate, scores
from sb3_dreamer_urlb.evaluation.aggregate import (
    combined_error,
    final_rows,
    iqm,
    mean_and_error,
    of_domain,
    performance_profile,
    probability_of_improvement,
    scores_of,
)
from sb3_dreamer_urlb.evaluation.names import TASKS
from sb3_dreamer_urlb.evaluation.rows import Row
from sb3_dreamer_urlb.evaluation.scores import DREAMER_2M, NORMALIZERS, ORACLE, URLB_EXPERT, normalized_score
from sb3_dreamer_urlb.version import how_to_install

ROW = Row("lbs", "walker", "run", 0, 2_000_000, 100_000, True, False, "dyna_mpc", "paper", 596.0, 17.0, 10)


def papers(name: str) -> list[Row]:
    """The paper's rows of a method."""
    found = scores.published_returns(name)
    return [
        replace(ROW, domain=key.split("-")[0], task=key.split("-")[1], return_mean=value.mean) for key, value in found.items()
    ]


@pytest.mark.parametrize(("name", "normalizer", "percent"), [("ours", DREAMER_2M, 93.5), ("disagreement", URLB_EXPERT, 39.0)])
def test_the_paper_s_rows_give_its_scores(name: str, normalizer: str, percent: float) -> None:
    overall = mean_and_error(scores_of(papers(name), normalizer))
    assert round(100 * overall.value, 1) == percent and overall.tasks == 12
    # What it writes itself comes from numbers that were not rounded.
    stated = scores.published_scores()["Ours" if name == "ours" else "Disagreement"]
    assert 100 * overall.value == pytest.approx(stated.mean, abs=0.15)
    errors = [value.error / NORMALIZERS[normalizer][task] for task, value in scores.published_returns(name).items()]
    assert 100 * combined_error(errors) == pytest.approx(stated.error, abs=0.1)


def test_reference_data_cover_the_benchmark() -> None:
    assert set(ORACLE) == set(NORMALIZERS[URLB_EXPERT]) == set(TASKS)
    assert (ORACLE["walker-flip"], ORACLE["jaco-reach_top_right"]) == (778, 225)
    assert NORMALIZERS[URLB_EXPERT]["quadruped-jump"] == 888
    assert scores.published_scores()["P2E + Dyna-MPC"] == scores.Published(88.86, 1.76)


def test_scores_of_domains_by_hand() -> None:
    rows = [
        replace(ROW, seed=0, return_mean=362.0),  # 0.5 of 724
        replace(ROW, seed=1, return_mean=724.0),  # 1.0
        replace(ROW, task="walk", seed=0, return_mean=965.0),
        replace(ROW, task="walk", seed=1, return_mean=965.0),
        replace(ROW, domain="quadruped", task="run", seed=0, return_mean=0.0),
        replace(ROW, domain="quadruped", task="run", seed=1, return_mean=904.0),
    ]
    found = scores_of(rows)
    assert found == {"walker-walk": [1.0, 1.0], "walker-run": [0.5, 1.0], "quadruped-run": [0.0, 1.0]}
    walker, overall = mean_and_error(of_domain(found, "walker")), mean_and_error(found)
    # Standard error of (0.5, 1): 0.25; of (0, 1): 0.5.
    assert (walker.value, walker.error) == (pytest.approx(0.875), pytest.approx(0.25 / 2))
    assert (overall.value, overall.error) == (pytest.approx(0.75), pytest.approx(math.sqrt(0.25**2 + 0.5**2) / 3))
    assert (overall.tasks, overall.seeds) == (3, (2, 2))
    assert math.isnan(mean_and_error(of_domain(found, "jaco")).value)
    assert math.isnan(mean_and_error({"walker-run": [1.0]}).error)


def test_normalized_score_says_what_is_unknown() -> None:
    assert normalized_score("walker-run", 398, URLB_EXPERT) == 0.5
    with pytest.raises(ValueError, match="Unknown task 'walker-swim'"):
        normalized_score("walker-swim", 1)
    with pytest.raises(ValueError, match="Unknown normalizer 'human'; known are"):
        normalized_score("walker-run", 1, "human")
    with pytest.raises(ValueError, match="got 'theirs'"):
        scores.published_returns("theirs")


def test_the_last_evaluation_within_the_budget_counts() -> None:
    rows = [replace(ROW, finetune_frames=frames, return_mean=frames / 1000) for frames in (90_000, 100_002, 50_000, 2_000_000)]
    unfinished = replace(ROW, seed=1, finetune_frames=40_000)
    done, short = final_rows([*rows, unfinished], 100_000)
    assert [row.return_mean for row in done] == [100.002] and short == [unfinished]
    assert [row.finetune_frames for row in final_rows(rows, 2_000_000)[0]] == [2_000_000]


@pytest.mark.parametrize(
    ("evaluated", "counts"),
    [
        ([90_000, 110_000], 110_000),
        ([90_000, 100_000, 104_000], 100_000),
        ([96_000, 110_000], 96_000),
        ([99_000, 101_000], 101_000),
        ([90_000, 125_000], 125_000),
        ([0, 90_000], None),
        ([90_000, 2_000_000], None),
    ],
)
def test_which_evaluation_is_the_one_at_the_budget(evaluated: list[int], counts: int | None) -> None:
    done, other = final_rows([replace(ROW, finetune_frames=frames) for frames in evaluated], 100_000)
    assert [row.finetune_frames for row in done] == ([] if counts is None else [counts])
    assert [row.finetune_frames for row in other] == ([90_000] if counts is None else [])


RAGGED = st.lists(st.lists(st.floats(-2, 2), min_size=1, max_size=6), min_size=1, max_size=5)


def named(tasks: Any) -> dict[str, Any]:
    return {TASKS[i]: values for i, values in enumerate(tasks)}


@given(tasks=RAGGED)
def test_iqm_is_the_mean_of_the_middle_half(tasks: list[list[float]]) -> None:
    pooled = np.sort(np.concatenate(tasks))
    cut = len(pooled) // 4
    assert iqm(named(tasks), repetitions=20).value == pytest.approx(pooled[cut : len(pooled) - cut].mean(), abs=1e-9)


def test_intervals_are_those_of_a_stratified_bootstrap() -> None:
    generator = np.random.default_rng(0)
    tasks = [generator.normal(i, 1, size) for i, size in enumerate((8, 5, 11))]
    found = iqm(named(tasks), repetitions=4000)
    draws = []
    for _ in range(4000):
        pooled = np.sort(np.concatenate([generator.choice(task, len(task)) for task in tasks]))
        cut = len(pooled) // 4
        draws.append(pooled[cut : len(pooled) - cut].mean())
    assert (found.low, found.high) == pytest.approx(tuple(np.percentile(draws, (2.5, 97.5))), abs=0.03)
    assert found.low < found.value < found.high and found.seeds == (5, 11)


def test_where_rliable_can_it_says_the_same() -> None:
    matrix = np.random.default_rng(1).uniform(0, 1, (6, 4))
    mine = iqm(named(matrix.T), repetitions=4000)
    value, interval = library.get_interval_estimates(
        {"a": matrix}, lambda x: np.array([metrics.aggregate_iqm(x)]), reps=4000, random_state=np.random.RandomState(0)
    )
    assert mine.value == pytest.approx(value["a"][0])
    assert (mine.low, mine.high) == pytest.approx(tuple(interval["a"][:, 0]), abs=0.01)
    thresholds = np.linspace(0, 1, 5)
    profile, bands = library.create_performance_profile({"a": matrix}, thresholds, reps=500)
    share, low, high = performance_profile(named(matrix.T), thresholds, repetitions=500)
    assert share == pytest.approx(profile["a"])
    assert low == pytest.approx(bands["a"][0], abs=0.06) and high == pytest.approx(bands["a"][1], abs=0.06)
    other = matrix[:, ::-1] + 0.2
    expected = metrics.probability_of_improvement(other, matrix)
    assert probability_of_improvement(named(other.T), named(matrix.T), repetitions=50).value == pytest.approx(expected)


def test_probability_of_improvement_by_hand() -> None:
    # 3 beats 1 and 2; 2 beats 1 and ties with 2: (1 + 1 + 1 + 0.5) / 4.
    found = probability_of_improvement({"walker-run": [3.0, 2.0], "walker-walk": [9.0]}, {"walker-run": [1.0, 2.0]}, 100)
    assert found.value == pytest.approx(0.875) and found.tasks == 1
    assert math.isnan(probability_of_improvement({"walker-run": [1.0]}, {"walker-walk": [1.0]}).value)


def test_a_single_seed_has_no_interval() -> None:
    found = iqm({"walker-run": [0.5], "walker-walk": [0.7]})
    assert found.value == pytest.approx(0.6) and math.isnan(found.low) and math.isnan(found.high)
    assert math.isnan(iqm({}).value)


def test_without_rliable_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rliable", None)
    for act in (lambda: iqm({}), lambda: performance_profile({}, [0.5]), lambda: probability_of_improvement({}, {})):
        with pytest.raises(ImportError, match=re.escape(f"need rliable; {how_to_install('plots')}")):
            act()
    assert aggregate.mean_and_error({"walker-run": [1.0]}).value == 1.0
