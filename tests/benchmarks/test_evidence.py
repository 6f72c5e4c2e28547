"""The campaign that asks whether pre-training pays: what it does, keeps, goes on with, and says."""

from __future__ import annotations

import dataclasses
import importlib
import random

import numpy as np
import pytest
from places import ROOT

from sb3_dreamer_urlb import DreamerV2
from sb3_dreamer_urlb.evaluation.rows import read_rows
from sb3_dreamer_urlb.evaluation.style import new_figure

COLUMNS = (
    "method,domain,task,seed,pretrain_frames,finetune_frames,keep_actor,keep_critic,planner,preset,return_mean,return_std,"
    "episodes,seconds"
)
ROW = "dreamer,walker,run,0,0,1000,,,dyna_mpc,tiny,42.0,0,1,1"


@pytest.fixture
def study(monkeypatch, tmp_path):
    """The campaign at the size of an episode a run, in a folder of its own."""
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    script = importlib.import_module("evidence_study")
    sizes = {"pretraining": 500, "finetuning": 500, "device": "cpu"}
    settings = {
        name: dataclasses.replace(setting, **sizes, preset="paper" if name == "paper" else "tiny")
        for name, setting in script.SETTINGS.items()
    }
    tiers = ((("lbs-kept", "scratch"), ("run",), 1),)
    for name, value in {"ROOT": tmp_path / "evidence", "SETTINGS": settings, "STUDY": dict.fromkeys(settings, tiers)}.items():
        monkeypatch.setattr(script, name, value)
    return script


@pytest.fixture
def evidence(monkeypatch, study):
    """The script that does it."""
    script = importlib.import_module("evidence")
    monkeypatch.setattr(script, "EPISODES", 1)
    return script


@pytest.fixture
def results(study):
    """What reads the runs."""
    return importlib.import_module("evidence_results")


def test_missing_runs_are_done_once(study, evidence, capsys):
    names = ["pretraining/lbs/0", "run/lbs-kept/0", "run/scratch/0"]
    assert [run.name for run in study.wanted()] == names
    evidence.work(float("inf"), at_most=1)
    assert list(study.curves()) == names[:1]
    pretrained = DreamerV2.load(study.snapshot_of(study.Run("lbs", "", 0)), device="cpu")
    assert (pretrained.phase, pretrained.num_timesteps) == ("pretraining", 500)
    evidence.work(float("inf"), None)
    evidence.work(float("inf"), None)  # nothing is left
    assert list(study.curves()) == names and all(len(run) == 1 for run in study.curves().values())
    rows = read_rows(study.ROOT / "rows.csv").rows
    assert [(row.further["arm"], row.planner, row.pretrain_frames) for row in rows] == [
        ("lbs-kept", "none", 1000),
        ("lbs-kept", "dyna_mpc", 1000),
        ("scratch", "none", 0),
        ("scratch", "dyna_mpc", 0),
    ]
    assert capsys.readouterr().out.count("done") == 3


def test_what_each_part_adds_by_hand(study, results):
    length = study.SETTINGS["state"].finetuning

    def run(*values):
        return [((i + 1) * length // 4, value) for i, value in enumerate(values)]

    runs = {
        f"flip/{arm}/{seed}": run(*(value + 10 * seed for value in values))
        for arm, values in {
            "scratch": (0, 0, 0, 0),
            "random-fresh": (4, 4, 4, 4),
            "lbs-fresh": (4, 8, 12, 16),
            "lbs-kept": (14, 10, 11, 17),
        }.items()
        for seed in range(2)
    }
    line = results.parts({**runs, "flip/scratch/7": run(900, 900, 900, 900), "run/scratch/0": run(1, 1, 1, 1)}).splitlines()[
        2:
    ]
    assert line == ["| flip | 2 | 5 | 9 | 15 | 18 | +10, +2, -1, +1 |"]


def test_another_process_at_a_run_is_left_alone(evidence, monkeypatch):
    monkeypatch.setattr(evidence, "do", lambda run: pytest.fail("it was begun twice"))
    with evidence.locked("pretraining-lbs-0.lock"), evidence.locked("run-scratch-0.lock"):
        evidence.work(float("inf"), None)  # its fine-tuning waits for the pre-training


def test_runs_from_pixels_have_their_own_names_and_no_statistics(study, evidence, tmp_path):
    names = ["pixels-pretraining/lbs/0", "pixels-run/lbs-kept/0", "pixels-run/scratch/0"]
    runs = list(study.wanted("pixels"))
    assert [run.name for run in runs] == names
    model = evidence.begin(runs[0], tmp_path)
    assert model.observation_space.shape == (3, 64, 64) and model.get_vec_normalize_env() is None
    evidence.keep(model, study.snapshot_of(runs[0]))
    assert [path.name for path in (study.ROOT / "snapshots").iterdir()] == ["pixels-lbs-0.zip"]
    tuned = evidence.begin(runs[1], tmp_path)
    assert (tuned.phase, tuned.num_timesteps) == ("finetuning", 0)


def test_what_an_arm_changes_is_changed_for_the_task_only(study, evidence, results, tmp_path):
    assert set(results.LABELS) == set(study.ARMS)
    run = study.Run("lbs-kept-target-2", "run", 0)
    pretraining = evidence.begin(run.needs, tmp_path)
    evidence.keep(pretraining, study.snapshot_of(run.needs))
    tuned = evidence.begin(run, tmp_path)
    plain = evidence.begin(study.Run("lbs-kept", "run", 0), tmp_path)
    assert (tuned.target_update_interval, tuned.kept["actor"]) == (2, True)
    assert pretraining.target_update_interval == plain.target_update_interval != 2


def test_scores_from_pixels_stand_apart(study, evidence, results):
    for size in study.SETTINGS:
        evidence.record(study.Run("scratch", "run", 0, size=size), [(500, 1.0)])
    (study.ROOT / "rows.csv").write_text(COLUMNS + ",observation,arm\n" + ROW + ",pixels,scratch\n")
    found = results.scores()
    assert set(found) == {"run", "pixels-run", "paper-run"}
    assert [task for task in found if found[task]["scratch"]["end, Dyna-MPC"]] == ["pixels-run"]


def write(study, evidence, returns):
    """Made-up finished runs: task → arm → a list of returns a seed."""
    study.ROOT.mkdir(parents=True)
    for task, arms in returns.items():
        for arm, runs in arms.items():
            for seed, values in enumerate(runs):
                evidence.record(study.Run(arm, task, seed), [(500 * (i + 1), value) for i, value in enumerate(values)])


def test_scores_are_means_of_episodes(study, evidence, results):
    write(study, evidence, {"run": {"scratch": [[1, 2, 3, 6], [5, 5, 5, 1]], "lbs-kept": [[9, 9, 9, 1]]}})
    (study.ROOT / "rows.csv").write_text(f"{COLUMNS},arm\n{ROW},scratch\n")
    found = results.scores()["run"]
    assert found["scratch"]["whole"] == [3, 4] and found["scratch"]["last quarter"] == [6, 1]
    assert found["scratch"]["end, Dyna-MPC"] == [42] and found["scratch"]["end, actor"] == []
    assert found["lbs-kept"]["whole"] == [7]


def test_a_table_has_what_is_known_and_no_more(results):
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


def test_curves_are_drawn(study, evidence, results, tmp_path):
    write(study, evidence, {"run": {"scratch": [[1, 2, 3], [2, 3, 4]], "lbs-kept": [[5, 6, 7], [6, 7, 8]]}})
    (study.ROOT / "rows.csv").write_text(COLUMNS + "\n")
    results.draw(tmp_path / "curves.png")
    assert (tmp_path / "curves.png").stat().st_size > 5000
    with pytest.raises(ValueError, match="two runs of an agent at least, and the setting 'pixels' has none yet"):
        results.draw(tmp_path / "pixels.png", "pixels")


@pytest.mark.parametrize("size", ["state", "pixels"])
def test_a_figure_shows_one_setting(study, evidence, results, tmp_path, monkeypatch, size):
    monkeypatch.setattr(study, "STUDY", dict.fromkeys(("state", "pixels"), ((("scratch",), ("run", "flip"), 2),)))
    runs = {"scratch": [[1, 2, 3], [2, 3, 4]]}
    write(study, evidence, {"run": runs, "flip": runs, "pixels-flip": runs})
    (study.ROOT / "rows.csv").write_text(COLUMNS + "\n")
    panels = []

    def figure_of(count, *inches):
        figure, axes = new_figure(count, *inches)
        panels.extend(axes)
        return figure, axes

    monkeypatch.setattr(results, "new_figure", figure_of)
    results.draw(tmp_path / "curves.png", size)
    assert [axes.get_title() for axes in panels] == ["walker run", "walker flip"][1 if size == "pixels" else 0 :]


def test_no_panel_for_a_single_run(study, evidence, results, tmp_path, monkeypatch):
    write(study, evidence, {"run": {"scratch": [[1, 2], [2, 3]]}, "flip": {"scratch": [[1, 2]], "lbs-kept": [[5, 6]]}})
    (study.ROOT / "rows.csv").write_text(COLUMNS + "\n")
    panels = []
    monkeypatch.setattr(results, "new_figure", lambda count, *size: panels.append(count) or new_figure(count, *size))
    results.draw(tmp_path / "curves.png")
    assert panels == [1]
