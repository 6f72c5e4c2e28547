"""The analyses from the command line, one after the other: a small study, done by hand and by the commands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from counter_task import ENV, STATES
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_dreamer_urlb import DreamerV2
from sb3_dreamer_urlb.__main__ import main
from sb3_dreamer_urlb.analysis.annotate import FROM_ONE_PRETRAINING, about, annotate
from sb3_dreamer_urlb.analysis.discrepancy import latent_dynamics_discrepancy
from sb3_dreamer_urlb.analysis.novelty import intrinsic_reward_on
from sb3_dreamer_urlb.analysis.trajectories import load_trajectories
from sb3_dreamer_urlb.evaluation.agent_rows import row_of
from sb3_dreamer_urlb.evaluation.append import append_rows
from sb3_dreamer_urlb.evaluation.episodes import run_evaluation
from sb3_dreamer_urlb.evaluation.rows import Row, read_rows
from sb3_dreamer_urlb.hub import load_vec_normalize, save_vec_normalize

SMALL = ("--episodes", "1", "--device", "cpu")


def test_the_whole_study(snapshots, weights, tmp_path, capsys):
    pretrained, tuned, rows, episodes = snapshots(), tmp_path / "tuned.zip", tmp_path / "rows.csv", tmp_path / "episodes"
    options = ["--finetune-frames", "56", "--freeze-decoder", "--save", str(tuned), "--rows", str(rows)]
    assert main(["zero-shot", str(pretrained), "--env", ENV, *options, *SMALL]) == 0
    shot, after = sorted(read_rows(rows).rows, key=lambda row: row.finetune_frames)
    for row, how, frames in ((shot, "zero_shot", 0), (after, "fine_tuned", 56)):
        about = (row.method, row.domain, row.task, row.seed, row.pretrain_frames, row.finetune_frames, row.planner)
        assert about == ("lbs", "walker", "run", 0, 56, frames, "mppi_zero_shot")
        assert (row["adaptation"], row["known_reward"], row.return_mean, row.keep_actor) == (how, "true", 4.0, False)
    before, model = (DreamerV2.load(path, device="cpu") for path in (pretrained, tuned))
    parts = [one.policy.agent.world_model for one in (before, model)]
    assert weights(parts[0].decoder) == weights(parts[1].decoder) and weights(parts[0].rssm) != weights(parts[1].rssm)

    oracle = ["--env", ENV, "--oracle", str(tuned), "--trajectories", str(episodes), "--count", "2", "--device", "cpu"]
    assert main(["discrepancy", str(pretrained), str(tuned), *oracle, "--rows", str(rows)]) == 0
    played = load_trajectories(episodes, 2)
    by_hand = np.mean(latent_dynamics_discrepancy(before, model, played))
    shot, after = sorted(read_rows(rows).rows, key=lambda row: row.finetune_frames)
    assert shot["ldd"] == "" and float(after["ldd"]) == pytest.approx(by_hand, rel=1e-5) and by_hand > 0

    recorded = ["--env", ENV, "--trajectories", str(episodes), "--count", "2", "--device", "cpu", "--rows", str(rows)]
    assert main(["oracle-reward", str(pretrained), *recorded]) == 0
    after = max(read_rows(rows).rows, key=lambda row: row.finetune_frames)
    assert float(after["intrinsic_reward"]) == pytest.approx(np.mean(intrinsic_reward_on(before, played)), rel=1e-5)
    assert float(after["ldd"]) == pytest.approx(by_hand, rel=1e-5) and len(read_rows(rows).rows) == 2
    assert "mean of 2 trajectories" in capsys.readouterr().out

    pytest.importorskip("matplotlib")
    assert main(["figures", str(rows), "--out", str(tmp_path / "figures"), "--repetitions", "10"]) == 0
    drawn = {path.stem for path in (tmp_path / "figures").rglob("*.png")}
    assert {"discrepancy", "zero_shot"} <= drawn


def test_a_study_of_an_agent_that_sees_normalised_states(tmp_path, capsys):
    """As a user does it: model.save, its statistics beside it, and every command finds them."""
    env = VecNormalize(make_vec_env(STATES, 1), norm_reward=False)
    model = DreamerV2("MlpPolicy", env, preset="tiny", seed=0, device="cpu", intrinsic_reward="lbs").learn(28)
    pretrained, tuned, rows = tmp_path / "before.zip", tmp_path / "after.zip", tmp_path / "rows.csv"
    model.save(pretrained)
    save_vec_normalize(env, tmp_path / "before.vec_normalize.json")
    options = ["--finetune-frames", "56", "--freeze-decoder", "--save", str(tuned), "--rows", str(rows)]
    assert main(["zero-shot", str(pretrained), "--env", STATES, *options, *SMALL]) == 0
    beside = [load_vec_normalize(path, make_vec_env(STATES, 1)) for path in sorted(tmp_path.glob("*.json"))]
    assert len(beside) == 2 and beside[0].obs_rms.mean.tolist() == beside[1].obs_rms.mean.tolist() == env.obs_rms.mean.tolist()
    oracle = ["--env", STATES, "--oracle", str(tuned), "--count", "2", "--device", "cpu", "--rows", str(rows)]
    assert main(["discrepancy", str(pretrained), str(tuned), *oracle]) == 0
    assert main(["oracle-reward", str(pretrained), *oracle]) == 0
    assert main(["keep-actor", str(pretrained), "--env", STATES, "--episodes", "1", "--device", "cpu"]) == 0
    assert main(["evaluate", str(tuned), "--env", STATES, "--planner", "on", *SMALL]) == 0
    after = max(read_rows(rows).rows, key=lambda row: row.finetune_frames)
    assert float(after["ldd"]) > 0 and after["intrinsic_reward"] != ""


@pytest.mark.parametrize(("method", "said"), [("icm", "learn_task_reward=True"), ("tuned", "needs a pre-trained snapshot")])
def test_who_cannot_plan_at_once_is_refused_before_anything(snapshots, tuned, tmp_path, capsys, method, said):
    path = tuned if method == "tuned" else snapshots(method)
    assert main(["zero-shot", str(path), "--env", ENV, "--rows", str(tmp_path / "rows.csv"), *SMALL]) == 2
    assert said in capsys.readouterr().err and not (tmp_path / "rows.csv").exists()


def test_a_second_head_is_a_known_reward(snapshots, capsys):
    path = snapshots("icm", learn_task_reward=True)
    assert main(["zero-shot", str(path), "--env", ENV, *SMALL]) == 0
    assert "zero_shot: return 4.0" in capsys.readouterr().out


def test_neither_oracle_nor_folder(snapshots, tuned, capsys):
    assert main(["discrepancy", str(snapshots()), str(tuned), "--env", ENV, "--device", "cpu"]) == 2
    assert "Give --oracle" in capsys.readouterr().err


def test_options_that_ask_for_nothing(snapshots, capsys):
    assert main(["zero-shot", str(snapshots()), "--env", ENV, "--freeze-decoder", *SMALL]) == 2
    assert "need --finetune-frames" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("--rows {folder}", "is a folder"),
        ("--rows {other}", "lacks the columns"),
        ("--npz {other}", "--npz must be the path of a folder"),
        ("--rows {other}/rows.csv", "the folder of the rows must be the path of a folder"),
        ("--rows {folder}/rows.csv --set method=xyz", "unknown method 'xyz'"),
        ("--rows {folder}/rows.csv --set return_mean=900", "--set return_mean: the evaluation measures that"),
        ("--rows {folder}/rows.csv --set planner=mppi", "--set planner: the evaluation measures that"),
        ("--rows {folder}/rows.csv --set seed=-1", "--set seed='-1'"),
        ("--rows {folder}/rows.csv --set ldd=much", "--set ldd='much'"),
        ("--device foo", "--device must be"),
        ("--env urlb/walker-fly-v0", "walker-fly"),
        ("--env=", "Malformed environment ID"),
        ("--env urlb/walker-run-v0", "needs --env-kwargs observation=state"),
    ],
)
def test_an_evaluation_that_will_fail_is_not_played(tuned, tmp_path, capsys, monkeypatch, options, said):
    from sb3_dreamer_urlb.evaluation import episodes

    monkeypatch.setattr(episodes, "run_evaluation", lambda *a, **k: pytest.fail("played"))
    (tmp_path / "other.csv").write_text("a;b\n")
    own = options.format(folder=tmp_path, other=tmp_path / "other.csv").split()
    assert main(["evaluate", str(tuned), "--env", ENV, *SMALL, *own]) == 2
    assert said in capsys.readouterr().err
    assert not (tmp_path / "rows.csv").exists()


def test_an_oracle_does_not_play_for_nothing(snapshots, tuned, tmp_path, capsys, monkeypatch):
    from sb3_dreamer_urlb.analysis import trajectories

    monkeypatch.setattr(trajectories, "play_trajectories", lambda *a, **k: pytest.fail("played"))
    rows = tmp_path / "rows.csv"
    options = ["--env", ENV, "--oracle", str(tuned), "--device", "cpu", "--rows", str(rows)]
    for command in (["discrepancy", str(snapshots()), str(tuned)], ["oracle-reward", str(snapshots())]):
        rows.unlink(missing_ok=True)
        assert main([*command, *options]) == 2
        assert "no file" in capsys.readouterr().err
        rows.write_text("a;b\n")
        assert main([*command, *options]) == 2
        assert "lacks the columns" in capsys.readouterr().err
        rows.unlink()
        append_rows(rows, [Row("icm", "walker", "run", 0, 56, 56, True, False, "none", "tiny", 1.0, 0.0, 1)])
        assert main([*command, *options]) == 2
        assert "no row about this agent" in capsys.readouterr().err


def test_one_episode_is_one_episode(tuned, tmp_path, capsys):
    assert main(["evaluate", str(tuned), "--env", ENV, *SMALL]) == 0
    assert "(1 episode," in capsys.readouterr().out


def test_only_the_rows_of_this_agent_are_written_to(snapshots, tuned, tmp_path):
    """Of one seed and one length, agents that kept other modules, or of another preset or observation, stay as they are."""
    model = DreamerV2.load(tuned, env=make_vec_env(ENV, 1), device="cpu")
    row = row_of(model, model.get_env(), run_evaluation(model, model.get_env(), 1))
    others = [
        replace(row, keep_actor=not row.keep_actor),
        replace(row, keep_critic=not row.keep_critic),
        replace(row, planner="dyna_mpc"),
        replace(row, preset="paper"),
        *(replace(row, further={**row.further, name: text}) for name, text in
          (("known_reward", "true"), ("observation", "state"), ("algorithm", "Other"))),
    ]  # fmt: skip
    append_rows(tmp_path / "rows.csv", [*others, row])
    assert annotate(tmp_path / "rows.csv", about(model, model.get_env(), tuned=False), "ldd", 0.5) == 1
    assert [found["ldd"] for found in read_rows(tmp_path / "rows.csv").rows] == [*[""] * len(others), "0.5"]
    before = DreamerV2.load(snapshots(), env=make_vec_env(ENV, 1), device="cpu")
    matches = about(before, before.get_env(), tuned=True)
    # Everything that came from one pre-training; other sizes and observations did not.
    assert annotate(tmp_path / "rows.csv", matches, "intrinsic_reward", 1.0, FROM_ONE_PRETRAINING) == 5


def test_rows_that_a_snapshot_cannot_tell_apart_are_not_written_to(tuned, tmp_path):
    model = DreamerV2.load(tuned, env=make_vec_env(ENV, 1), device="cpu")
    row = row_of(model, model.get_env(), run_evaluation(model, model.get_env(), 1))
    path = tmp_path / "rows.csv"
    append_rows(path, [row, replace(row, further={**row.further, "arm": "mine"})])
    text = path.read_text()
    with pytest.raises(ValueError, match="2 rows that may be about this agent, and they differ in arm"):
        annotate(path, about(model, model.get_env(), tuned=False), "ldd", 0.5)
    assert path.read_text() == text


def test_a_file_without_the_agent_stays_as_it_is(tmp_path):
    path = tmp_path / "rows.csv"
    head = "method,domain,task,seed,pretrain_frames,finetune_frames,keep_actor,keep_critic,planner,preset"
    text = f"{head},return_mean,return_std,episodes,seconds\nlbs,walker,run,0,2M,100k,true,false,none,paper,1,0,10,1\nhalf,\n"
    path.write_text(text)
    with pytest.raises(ValueError, match="no row about this agent"):
        annotate(path, lambda row: row.seed == 1, "ldd", 0.5)
    assert path.read_text() == text
    with pytest.raises(FileNotFoundError, match="no file"):
        annotate(tmp_path / "none.csv", lambda row: True, "ldd", 0.5)
    assert annotate(path, lambda row: row.seed == 0, "ldd", 0.5) == 1
    assert annotate(path, lambda row: row.seed == 0, "ldd", 0.25) == 1
    found = read_rows(path)
    assert [row["ldd"] for row in found.rows] == ["0.25"] and len(found.skipped) == 1
