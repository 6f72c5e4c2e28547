"""The paper's ablations as lists of runs, and the runner that does what is missing."""

from __future__ import annotations

from dataclasses import replace

import gymnasium
import pytest
from counter_task import ENV, STATES
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_dreamer_urlb.__main__ import main
from sb3_dreamer_urlb.analysis.manifests import MANIFESTS, Plan, runs_of
from sb3_dreamer_urlb.analysis.study import StudyFolder, normalized_states
from sb3_dreamer_urlb.analysis.study_settings import remember
from sb3_dreamer_urlb.cli.study import NAMES
from sb3_dreamer_urlb.evaluation.append import append_rows
from sb3_dreamer_urlb.evaluation.rows import Row, read_rows
from sb3_dreamer_urlb.snapshots.vec_normalize import beside, load_vec_normalize

SMALL = {"seeds": 1, "methods": ("lbs",), "tasks": ("walker-run",), "pretrain": (40, 56), "finetune": 48}


def small(name, **changes):
    return runs_of(name, Plan(**{**SMALL, **changes}))


def make_env(name, count):
    """A cheap environment in the place of whichever was asked for."""
    assert name in gymnasium.registry
    return make_vec_env(ENV, count)


def folder(path):
    return StudyFolder(path, {"preset": "tiny", "device": "cpu", "learning_starts": 12}, 1, make_env)


def test_the_papers_plans():
    assert set(MANIFESTS) == set(NAMES)
    counts = {name: len(runs_of(name, manifest.plan)) for name, manifest in MANIFESTS.items()}
    # seeds · tasks · methods · arms
    assert counts == {
        "known-reward": 3 * 12 * 7 * 2,
        "zero-shot": 3 * 12 * 1 * 2,
        "modules": 3 * 12 * 7 * 6,
        "longer": 3 * 12 * 7 * 7,
        "sparsity": 3 * 4 * 7 * 6,
    }
    for name, manifest in MANIFESTS.items():
        runs = runs_of(name, manifest.plan)
        assert len({run.name for run in runs}) == len(runs)
        assert all(env in gymnasium.registry for run in runs for env in (run.env, run.start.env))
        assert all(run.start.env.startswith(run.env.rpartition("-")[0][:9]) for run in runs)


def test_a_reward_is_known_where_it_was_seen():
    for run in [*small("known-reward", tasks=("jaco-reach_top_left",)), *small("zero-shot")]:
        assert run.start.env == run.env
    assert small("known-reward", tasks=("jaco-reach_top_left",))[0].env == "urlb/jaco-reach_top_left-fixed-v0"
    assert small("modules")[0].start.env == "urlb/walker-stand-v0"


def test_unknown_tasks_and_empty_studies_are_refused():
    with pytest.raises(ValueError, match="Unknown task 'walker-dance'"):
        Plan(tasks=("walker-dance",))
    with pytest.raises(ValueError, match="is about Jaco"):
        small("sparsity")
    with pytest.raises(ValueError, match="positive numbers"):
        Plan(seeds=0)
    with pytest.raises(ValueError, match="Unknown study 'none'"):
        runs_of("none", Plan())


def test_what_is_missing_is_done_once(tmp_path):
    study, runs = folder(tmp_path), small("longer")
    assert [run.length for run in study.missing(runs)] == [40, 56]
    assert study.work(runs, at_most=1) == 1 and len(study.missing(runs)) == 1
    before = study.snapshot(runs[0].start, 56).read_bytes()
    # Another process, later.
    again = folder(tmp_path)
    assert again.work(runs) == 1 and again.work(runs) == 0 and again.missing(runs) == []
    assert study.snapshot(runs[0].start, 56).read_bytes() == before
    assert [path for path in (tmp_path / "runs").iterdir() if path.is_dir()] == []
    with pytest.raises(ValueError, match="other lengths need another folder"):
        study.work(small("longer", pretrain=(48, 56)))
    rows = read_rows(study.rows).rows
    # Snapshots may come a step late.
    assert [(row.pretrain_frames, row.finetune_frames, row.keep_actor) for row in rows] == [(40, 48, True), (56, 48, True)]


def test_zero_shot_and_modules_share_nothing_but_the_folder(tmp_path):
    study = folder(tmp_path)
    runs = small("zero-shot", methods=("icm",), pretrain=(56,))
    assert study.work(runs) == 2
    rows = {row.finetune_frames: row for row in read_rows(study.rows).rows}
    assert {frames: row.planner for frames, row in rows.items()} == {0: "mppi_zero_shot", 48: "mppi_zero_shot"}
    assert all(row["known_reward"] == "true" for row in rows.values())
    critic = [run for run in small("modules", pretrain=(56,)) if run.keep_critic and run.planner is None]
    assert study.work(critic) == 1
    row = next(row for row in read_rows(study.rows).rows if row.keep_critic)
    assert (row.method, row.keep_actor, row.planner) == ("lbs", True, "none")


def test_agents_without_pre_training_beside_a_study(tmp_path):
    runs = runs_of("longer", Plan(**{**SMALL, "pretrain": (40,)}), scratch=True)
    [tuned, scratch] = runs
    assert (scratch.start.method, scratch.env, scratch.frames) == ("scratch", tuned.env, tuned.frames)
    study = folder(tmp_path)
    assert study.work(runs) == 2 and study.missing(runs) == []
    rows = {row["run_folder"]: row for row in read_rows(study.rows).rows}
    row = rows[scratch.name]
    assert (row.method, row.pretrain_frames, row.finetune_frames, row.keep_actor) == ("dreamer", 0, 48, None)
    assert (rows[tuned.name].keep_actor, rows[tuned.name].keep_critic) == (True, False)
    assert sorted(path.name for path in (tmp_path / "snapshots").iterdir()) == [tuned.start.name]
    fixed = runs_of("zero-shot", Plan(**{**SMALL, "tasks": ("jaco-reach_top_left",)}), scratch=True)
    assert {run.env for run in fixed} == {"urlb/jaco-reach_top_left-fixed-v0"}


def test_a_study_from_normalised_states(tmp_path):
    """Fine-tuning goes on with the statistics of its snapshot, and evaluations see as the agent does."""

    def states(name, count):
        return VecNormalize(make_vec_env(STATES, count), norm_reward=False)

    study = StudyFolder(tmp_path, {"preset": "tiny", "device": "cpu", "learning_starts": 12}, 1, states)
    runs = runs_of("longer", Plan(**{**SMALL, "pretrain": (40,)}), scratch=True)
    assert study.work(runs) == 2
    begun = load_vec_normalize(beside(study.snapshot(runs[0].start, 40)), make_vec_env(STATES, 1)).obs_rms.count
    ended = load_vec_normalize(beside(tmp_path / "tuned" / f"{runs[0].name}.zip"), make_vec_env(STATES, 1)).obs_rms.count
    # 20 steps and their reset, then 24 steps and theirs.
    assert ended - begun == pytest.approx(begun + 4, abs=6) and begun >= 20
    [alone] = [run for run in runs if run.start.method == "scratch"]
    assert beside(tmp_path / "tuned" / f"{alone.name}.zip").exists()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"arguments": {"preset": "small", "learning_starts": 12}}, "preset='tiny', and preset='small' is asked for"),
        ({"arguments": {"preset": "tiny", "learning_starts": 12, "batch_size": 4}}, "batch_size=None"),
        ({"episodes": 3}, "episodes=1, and episodes=3"),
        ({"make_env": normalized_states}, r"observation='test_study.make_env', and observation='state'"),
    ],
)
@pytest.mark.parametrize("remembers", [True, False])
def test_a_folder_is_of_one_setting(tmp_path, changes, said, remembers):
    runs = small("longer", pretrain=(56,))
    study = folder(tmp_path)
    assert study.missing(runs) == runs and not list(tmp_path.iterdir())
    remember(tmp_path, study.settings)
    if not remembers:
        # From before folders knew their settings: their rows say some.
        (tmp_path / "study.json").unlink()
        append_rows(study.rows, [Row("lbs", "walker", "run", 9, 56, 48, True, False, "none", "tiny", 1.0, 0.0, 1)])
        said = said.replace("test_study.make_env", "pixels")
    assert folder(tmp_path).missing(runs) == runs
    elsewhere = replace(study, arguments={**study.arguments, "device": "cuda"})
    assert elsewhere.missing(runs) == runs
    if not remembers and "batch_size" in said:
        return
    for act in ("missing", "work"):
        with pytest.raises(ValueError, match=f"{said}.*or another --folder"):
            getattr(replace(study, **changes), act)(runs)


def test_a_damaged_memory_is_named(tmp_path):
    (tmp_path / "study.json").write_text("{")
    with pytest.raises(ValueError, match=r"study.json is damaged"):
        folder(tmp_path).missing(small("longer"))


def test_who_finds_nothing_to_do_says_why(tmp_path, capsys):
    study, runs = folder(tmp_path), small("longer", pretrain=(56,))
    with study._locked(runs[0].start.name):
        assert folder(tmp_path).work(runs) == 0
    assert f"at it: the pre-training {runs[0].start.name}." in capsys.readouterr().out
    append_rows(study.rows, [Row("lbs", "walker", "run", 0, 56, 48, True, False, "none", "tiny", 1.0, 0.0, 1,
                                 further={"run_folder": runs[0].name})])  # fmt: skip
    assert study.work(runs) == 0 and "Nothing is missing." in capsys.readouterr().out


def test_an_interrupted_study_says_how_it_goes_on(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(StudyFolder, "work", lambda *a: (_ for _ in ()).throw(KeyboardInterrupt))
    options = ["--folder", str(tmp_path), "--methods", "lbs", "--tasks", "walker-run", "--seeds", "1"]
    assert main(["study", "modules", "run", *options]) == 130
    assert capsys.readouterr().err == "sb3-dreamer-urlb: interrupted; the same command goes on where it was.\n"


def test_the_command_lists(tmp_path, capsys):
    options = ["--folder", str(tmp_path), "--methods", "lbs", "--tasks", "walker-run", "--seeds", "1"]
    assert main(["study", "modules", "list", *options]) == 0
    out = capsys.readouterr().out
    assert out.count("missing lbs-walker-stand-0-2000000/2000000/walker-run/model") == 6 and "0 of 6 done" in out
    assert main(["study", "modules", "list", *options[:2], "--methods", "nobody"]) == 2
    assert "nobody" in capsys.readouterr().err


def test_a_run_that_is_cut_off_goes_on(tmp_path, monkeypatch):
    """The evaluation fails after fine-tuning: another process does not begin anew."""
    from sb3_dreamer_urlb import DreamerV2
    from sb3_dreamer_urlb.analysis import study as module

    study, runs = folder(tmp_path), small("longer", pretrain=(56,))
    with monkeypatch.context() as broken:
        broken.setattr(module, "run_evaluation", lambda *a, **k: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            study.work(runs)
    assert study.missing(runs) == runs
    updates = []
    train = DreamerV2.train
    monkeypatch.setattr(DreamerV2, "train", lambda self, *a, **k: (updates.append(1), train(self, *a, **k)))
    assert folder(tmp_path).work(runs) == 1 and updates == []
