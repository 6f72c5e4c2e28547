"""The campaign that asks whether pre-training pays: what it does, keeps, goes on with, and says."""

from __future__ import annotations

import csv
import importlib
import random

import numpy as np
import pytest
from places import ROOT

from sb3_dreamer_urlb import DreamerV2
from sb3_dreamer_urlb.evaluation.rows import read_rows


@pytest.fixture
def evidence(monkeypatch, tmp_path):
    """The script at the size of an episode a run, in a folder of its own."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    script = importlib.import_module("evidence")
    small = {"ROOT": tmp_path / "evidence", "PRESET": "tiny", "PRETRAINING": 500, "FINETUNING": 500, "EPISODES": 1}
    for name, value in {**small, "STUDY": ((("lbs-kept", "scratch"), ("run",), 1),)}.items():
        monkeypatch.setattr(script, name, value)
    return script


@pytest.fixture
def results(evidence):
    """What reads the runs."""
    return importlib.import_module("evidence_results")


def test_missing_runs_are_done_once(evidence, capsys):
    names = ["pretraining/lbs/0", "run/lbs-kept/0", "run/scratch/0"]
    assert [run.name for run in evidence.wanted()] == names
    evidence.work(float("inf"), at_most=1)
    assert list(evidence.curves()) == names[:1]
    pretrained = DreamerV2.load(evidence.snapshot_of(evidence.Run("lbs", "", 0)), device="cpu")
    assert (pretrained.phase, pretrained.num_timesteps) == ("pretraining", 500)
    evidence.work(float("inf"), None)
    evidence.work(float("inf"), None)  # nothing is left
    assert list(evidence.curves()) == names and all(len(run) == 1 for run in evidence.curves().values())
    rows = read_rows(evidence.ROOT / "rows.csv").rows
    assert [(row.further["arm"], row.planner, row.pretrain_frames) for row in rows] == [
        ("lbs-kept", "none", 1000),
        ("lbs-kept", "dyna_mpc", 1000),
        ("scratch", "none", 0),
        ("scratch", "dyna_mpc", 0),
    ]
    assert capsys.readouterr().out.count("done") == 3


def test_another_process_at_a_run_is_left_alone(evidence, monkeypatch):
    monkeypatch.setattr(evidence, "do", lambda run: pytest.fail("it was begun twice"))
    with evidence.locked("pretraining-lbs-0.lock"), evidence.locked("run-scratch-0.lock"):
        evidence.work(float("inf"), None)  # its fine-tuning waits for the pre-training


def write(evidence, returns):
    """Made-up finished runs: task → arm → a list of returns a seed."""
    evidence.ROOT.mkdir(parents=True)
    for task, arms in returns.items():
        for arm, runs in arms.items():
            for seed, values in enumerate(runs):
                evidence.record(evidence.Run(arm, task, seed), [(500 * (i + 1), value) for i, value in enumerate(values)])


def test_scores_are_means_of_episodes(evidence, results):
    write(evidence, {"run": {"scratch": [[1, 2, 3, 6], [5, 5, 5, 1]], "lbs-kept": [[9, 9, 9, 1]]}})
    (evidence.ROOT / "rows.csv").write_text(",".join(("method", "domain")) + "\n")
    with open(evidence.ROOT / "rows.csv", "w", newline="") as file:
        columns = "method,domain,task,seed,pretrain_frames,finetune_frames,keep_actor,keep_critic,planner,preset,return_mean"
        writer = csv.writer(file)
        writer.writerow([*columns.split(","), "return_std", "episodes", "seconds", "arm"])
        writer.writerow(["dreamer", "walker", "run", 0, 0, 1000, "", "", "dyna_mpc", "tiny", 42.0, 0, 1, 1, "scratch"])
    found = results.scores()["run"]
    assert found["scratch"]["whole"] == [3, 4] and found["scratch"]["last quarter"] == [6, 1]
    assert found["scratch"]["end, Dyna-MPC"] == [42] and found["scratch"]["end, actor"] == []
    assert found["lbs-kept"]["whole"] == [7]


def test_a_table_has_what_is_known_and_no_more(evidence, results):
    four = {name: [1.0, 2.0, 3.0, 4.0] for name in results.MEASURES}
    lines = results.table({"run": {"scratch": four, "lbs-kept": {name: [5.0] for name in results.MEASURES}}}).splitlines()
    assert len(lines) == 3 and lines[2].startswith("| run | from scratch | 4 | 2 [")


def test_seeds_needed(results):
    """A shift of one standard deviation needs 16 an arm, as every table of power says; half of it four times as many."""
    generator = random.Random(0)
    noise = np.array([generator.gauss(0, 1) for _ in range(2000)])
    noise = (noise - noise.mean()) / noise.std(ddof=1)
    assert results.seeds_needed(noise + 1, noise) == 16 and results.seeds_needed(noise, noise + 0.5) == 63
    assert results.seeds_needed([5.0, 5.0], [1.0, 1.0]) == 2


def test_curves_are_drawn(evidence, results, tmp_path):
    write(evidence, {"run": {"scratch": [[1, 2, 3], [2, 3, 4]], "lbs-kept": [[5, 6, 7], [6, 7, 8]]}})
    (evidence.ROOT / "rows.csv").write_text(
        "method,domain,task,seed,pretrain_frames,finetune_frames,keep_actor,keep_critic,planner,preset,return_mean,return_std,"
        "episodes,seconds\n"
    )
    results.draw(tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 5000
