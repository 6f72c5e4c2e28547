"""The callback that evaluates while fine-tuning, and the command that evaluates a snapshot."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from fake_envs import CounterEnv
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from told import told_meanwhile

from sb3_dreamer_urlb import DreamerV2, DrQv2, EvaluationCallback, PhaseSwitchCallback, RunCheckpointCallback
from sb3_dreamer_urlb.__main__ import main
from sb3_dreamer_urlb.evaluation.arms import standard
from sb3_dreamer_urlb.evaluation.rows import read_rows

WALKER = {"domain": "walker", "task": "run", "action_repeat": 2}


@pytest.fixture(autouse=True)
def _counter_env() -> Any:
    gymnasium.register("Counter-v0", entry_point=CounterEnv, kwargs={"length": 20, **WALKER})
    yield
    del gymnasium.registry["Counter-v0"]


def test_rows_and_evaluations_npz_of_a_run(tiny_model: Any, tmp_path: Path) -> None:
    model = tiny_model(CounterEnv(20, **WALKER), intrinsic_reward="lbs")
    rows = tmp_path / "rows.csv"
    evaluation = EvaluationCallback(
        CounterEnv(20, **WALKER), 40, 2, rows, log_path=str(tmp_path), best_model_save_path=str(tmp_path / "best"),
        columns={"arm": "a"},
    )  # fmt: skip
    model.learn(100, callback=[PhaseSwitchCallback(64, keep_actor=False), evaluation])
    found = read_rows(rows).rows
    # 32 steps of pre-training, then 68 steps of two frames.
    assert [row.finetune_frames for row in found] == [40, 80, 120]
    assert {(row.method, row.pretrain_frames, row.keep_actor, row.episodes, row["arm"]) for row in found} == {
        ("lbs", 64, False, 2, "a")
    }
    saved = np.load(tmp_path / "evaluations.npz")
    assert saved["results"].shape == saved["ep_lengths"].shape == (3, 2)
    assert list(saved["timesteps"]) == [52, 72, 92]
    assert np.allclose(saved["results"].mean(1), [row.return_mean for row in found])
    assert evaluation.best_mean_reward == max(row.return_mean for row in found)
    assert DreamerV2.load(tmp_path / "best" / "best_model").phase == "finetuning"


def test_both_rows_with_a_planner(tiny_model: Any, tmp_path: Path) -> None:
    model = tiny_model(CounterEnv(20, **WALKER), planner="dyna_mpc", planner_delay=1000)
    model.learn(20, callback=EvaluationCallback(CounterEnv(5, **WALKER), 40, 1, tmp_path / "rows.csv", planner="both"))
    assert [(row.method, row.planner) for row in read_rows(tmp_path / "rows.csv").rows] == [
        ("dreamer", "dyna_mpc"),
        ("dreamer", "none"),
    ]


def test_a_run_that_goes_on_writes_each_row_once(tiny_model: Any, tmp_path: Path) -> None:
    def go_on(steps: int) -> None:
        evaluation = EvaluationCallback(CounterEnv(5, **WALKER), 20, 1, tmp_path / "rows.csv", log_path=str(tmp_path))
        keep = RunCheckpointCallback(tmp_path / "run", 20, evaluation, resume="auto")
        tiny_model(CounterEnv(20, **WALKER)).learn(steps, callback=[keep, evaluation])

    go_on(25)
    go_on(60)
    found = read_rows(tmp_path / "rows.csv")
    assert found.report() == "" and [row.finetune_frames for row in found.rows] == [20, 40, 60, 80, 100, 120]
    assert found.rows[0]["run_folder"] == str(tmp_path / "run")
    assert list(np.load(tmp_path / "evaluations.npz")["timesteps"]) == [10, 20, 30, 40, 50, 60]


def test_a_result_that_contradicts_the_file_does_not_end_the_run(tiny_model: Any, tmp_path: Path) -> None:
    for length, warned in ((5, False), (6, True)):
        callback = EvaluationCallback(CounterEnv(length, **WALKER), 20, 1, tmp_path / "rows.csv")
        with told_meanwhile() as said:
            tiny_model(CounterEnv(20, **WALKER)).learn(10, callback=callback)
        assert any("another result of the same run" in text for text in said) is warned
    assert len(read_rows(tmp_path / "rows.csv").rows) == 1


def test_learning_is_not_touched(tiny_model: Any, weights: Any) -> None:
    learnt = []
    for callback in (None, EvaluationCallback(CounterEnv(20), 10, 1)):
        model = tiny_model(CounterEnv(20), learning_starts=20)
        learnt.append(weights(model.learn(60, callback=callback).policy))
    assert learnt[0] == learnt[1]


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"every_frames": 0}, "every_frames must be an integer of at least 1, got 0"),
        ({"n_eval_episodes": 1.5}, "n_eval_episodes must be an integer"),
        ({"planner": "yes"}, "planner must be one of"),
    ],
)
def test_bad_input(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        EvaluationCallback(CounterEnv(), **kwargs)


@pytest.mark.parametrize(("name", "instead"), [("eval_freq", "every_frames=..."), ("render", "VideoCallback")])
def test_what_it_does_otherwise_than_its_base_is_said(name: str, instead: str) -> None:
    with pytest.raises(TypeError, match=rf"EvaluationCallback takes no {name}: {instead}"):
        EvaluationCallback(CounterEnv(), **{name: 500})


def test_what_cannot_work_is_said_before_learning(tiny_model: Any, tmp_path: Path) -> None:
    model = tiny_model()
    with pytest.raises(ValueError, match="the one that is trained in"):
        model.learn(5, callback=EvaluationCallback(model.get_env()))
    with pytest.raises(ValueError, match="planner='on': the model has none"):
        model.learn(5, callback=EvaluationCallback(CounterEnv(), planner="on"))
    with pytest.raises(ValueError, match="Rows tell runs apart by their seed"):
        tiny_model(seed=None).learn(5, callback=EvaluationCallback(CounterEnv(), rows=tmp_path / "rows.csv"))
    with pytest.raises(ValueError, match="VecNormalize"):
        model.learn(5, callback=EvaluationCallback(VecNormalize(DummyVecEnv([CounterEnv]))))
    with pytest.raises(ValueError, match="Observation spaces do not match"):
        model.learn(5, callback=EvaluationCallback(CounterEnv(size=20), log_path=str(tmp_path / "log")))
    assert model.num_timesteps == 0 and not (tmp_path / "log").exists()


# -- the command -------------------------------------------------------------------------------------------------------


def test_the_command_evaluates_a_snapshot(tiny_model: Any, tmp_path: Path, capsys: Any) -> None:
    tiny_model(CounterEnv(20, **WALKER), planner="dyna_mpc").save(tmp_path / "agent")
    command = ["evaluate", str(tmp_path / "agent.zip"), "--env", "Counter-v0", "--episodes", "2", "--planner", "both"]
    command += [
        "--rows",
        str(tmp_path / "rows.csv"),
        "--npz",
        str(tmp_path),
        "--set",
        "arm=a",
        "device=cpu",
        "--device",
        "cpu",
    ]
    assert main(command) == 0
    rows = read_rows(tmp_path / "rows.csv").rows
    assert [(row.planner, row.episodes, row["arm"], row.domain) for row in rows] == [
        ("dyna_mpc", 2, "a", "walker"),
        ("none", 2, "a", "walker"),
    ]
    assert np.load(tmp_path / "evaluations.npz")["results"].shape == (1, 2)
    out = capsys.readouterr().out
    assert "planner dyna_mpc: return" in out and "actor alone: return" in out and out.count("added to") == 2
    assert main(command) == 0 and capsys.readouterr().out.count("stands already in") == 2


def test_the_command_takes_a_run_folder_with_its_statistics(tiny_model: Any, tmp_path: Path) -> None:
    def normalized() -> VecNormalize:
        return VecNormalize(make_vec_env("Pendulum-v1", 1, seed=0), norm_reward=False)

    model = tiny_model(normalized(), "MlpPolicy")
    model.learn(30, callback=RunCheckpointCallback(tmp_path / "run"))
    rows = tmp_path / "rows.csv"
    arguments = ["--env", "Pendulum-v1", "--episodes", "2", "--envs", "1", "--rows", str(rows), "--device", "cpu"]
    assert main(["evaluate", str(tmp_path / "run"), *arguments]) == 0
    [row] = read_rows(rows, strict=False).rows
    evaluation = EvaluationCallback(normalized(), 10, 2)
    evaluation.init_callback(model)
    evaluation.evaluate()
    assert row.return_mean == pytest.approx(evaluation.last_mean_reward, rel=1e-4)


def test_the_model_free_agent_is_evaluated_alike(tmp_path: Path) -> None:
    model = DrQv2("CnnPolicy", CounterEnv(20, size=84, **WALKER), preset="tiny", seed=0, device="cpu")
    rows = tmp_path / "rows.csv"
    model.learn(20, callback=EvaluationCallback(CounterEnv(5, size=84, **WALKER), 20, 1, rows, planner="both"))
    model.save(tmp_path / "agent")
    command = ["evaluate", str(tmp_path / "agent.zip"), "--env", "Counter-v0", "--env-kwargs", "size=84", "length=5"]
    command += ["--episodes", "1", "--device", "cpu", "--set", "arm=again", "--planner", "both"]
    assert main([*command, "--rows", str(rows)]) == 0
    assert [(row.method, row["algorithm"], row.planner, row.finetune_frames) for row in read_rows(rows).rows] == [
        ("drqv2", "DrQv2", "none", 20),
        ("drqv2", "DrQv2", "none", 40),
        ("drqv2", "DrQv2", "none", 40),
    ]


def test_who_has_no_planner_says_so(tmp_path: Path, capsys: Any) -> None:
    model = DrQv2("CnnPolicy", CounterEnv(5), preset="tiny", seed=0, device="cpu")
    model.save(tmp_path / "agent")
    command = ["evaluate", str(tmp_path / "agent.zip"), "--env", "Counter-v0", "--device", "cpu", "--planner", "on"]
    assert main(command) == 2
    assert "planner='on': DrQv2 has no planner" in capsys.readouterr().err
    with pytest.raises(ValueError, match="planner='on': DrQv2 has no planner"):
        model.learn(4, EvaluationCallback(CounterEnv(5), planner="on"))


def test_an_agent_that_explores_is_no_best_one_of_the_task(tiny_model: Any, tmp_path: Path) -> None:
    model = tiny_model(CounterEnv(5, **WALKER), intrinsic_reward="lbs", learning_starts=100)
    evaluation = EvaluationCallback(CounterEnv(5, **WALKER), 20, 1, pretraining=True, best_model_save_path=tmp_path)
    model.learn(20, evaluation)
    best, mean = DreamerV2.load(tmp_path / "best_model"), evaluation.best_mean_reward
    assert best.phase == "pretraining" and np.isfinite(mean)
    evaluation.best_mean_reward = 1e9  # as if exploring had paid
    model.fine_tune()
    model.learn(20, evaluation, reset_num_timesteps=False)
    assert evaluation.best_mean_reward == mean and DreamerV2.load(tmp_path / "best_model").phase == "finetuning"


def test_the_command_takes_the_folder_of_a_run_of_the_zoo(tiny_model: Any, tmp_path: Path, capsys: Any) -> None:
    run = tmp_path / "logs" / "run_1"
    tiny_model(CounterEnv(5)).learn(8, RunCheckpointCallback(run / "checkpoint", every_frames=4))
    command = ["--env", "Counter-v0", "--env-kwargs", "length=5", "--episodes", "1", "--device", "cpu"]
    assert main(["evaluate", str(run), *command]) == 0
    assert main(["evaluate", str(tmp_path), *command]) == 2
    assert f"{tmp_path} has no checkpoint" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--set", "arm=mine"], "--set is about the row: it needs --rows FILE."),
        (["--set", "arm", "--rows", "rows.csv"], "--set: expected NAME=VALUE, got 'arm'"),
        (["--set", "keep_actor=perhaps", "--rows", "rows.csv"], "expected true, false or none, got 'perhaps'"),
        (["--planner", "on"], "the model has none"),
        (["--env-kwargs", "length"], "--env-kwargs: expected NAME=VALUE"),
        (["--env-kwargs", "length=3", "length=4"], "--env-kwargs: length is given twice, as '3' and as '4'"),
        (["--env-kwargs", "length=3", "size=1.5"], "cannot be made with --env-kwargs {'length': 3, 'size': 1.5}"),
        (["--env-kwargs", "max_episode_steps=1.5"], "cannot be made with --env-kwargs {'max_episode_steps': 1.5}"),
        (["--rows", "pipe"], "pipe is no file that rows can be kept in"),
        (["--set", "keep_actor=true", "--rows", "rows.csv"], "--set keep_actor: the agent was not fine-tuned"),
    ],
)
def test_the_command_says_what_is_wrong(
    arguments: list[str], message: str, tiny_model: Any, tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    tiny_model(CounterEnv(20, **WALKER)).save(tmp_path / "agent")
    assert (
        main(["evaluate", "agent.zip", "--env", "Counter-v0", "--device", "cpu", "--env-kwargs", "length=3", *arguments]) == 2
    )
    assert message in capsys.readouterr().err


def test_no_snapshot(tmp_path: Path, capsys: Any) -> None:
    assert main(["evaluate", str(tmp_path / "none.zip"), "--env", "Counter-v0"]) == 2
    assert "none.zip" in capsys.readouterr().err


def test_rows_that_cannot_be_written_are_told_before_the_first_step(tiny_model, tmp_path):
    model = tiny_model(CounterEnv(20, **WALKER), seed=0)
    with pytest.raises(IsADirectoryError, match="is a folder: give a CSV file"):
        model.learn(5, callback=EvaluationCallback(CounterEnv(20, **WALKER), rows=tmp_path))
    assert model.num_timesteps == 0


# -- what the benchmark's tables are not about -----------------------------------------------------------------------------


@pytest.fixture
def evaluate(tiny_model: Any, tmp_path: Path, capsys: Any) -> Any:
    """Evaluate a model fine-tuned on walker run, with further options: status, output, rows."""
    model = tiny_model(CounterEnv(5, **WALKER), seed=0)
    model.learn(10).save(tmp_path / "agent")

    def command(*arguments: str) -> Any:
        rows = ["--rows", str(tmp_path / "rows.csv")] if "--rows" not in arguments else []
        own = ["--env", "Counter-v0", "--device", "cpu", "--episodes", "2"]
        status = main(["evaluate", str(tmp_path / "agent.zip"), *own, *rows, *arguments])
        said = capsys.readouterr()
        there = (tmp_path / "rows.csv").exists()
        return status, said.out + said.err, read_rows(tmp_path / "rows.csv").rows if there else []

    return command


def test_an_agent_that_draws_its_actions_has_a_row_of_its_own(evaluate: Any) -> None:
    status, _, [explored] = evaluate("--stochastic")
    assert status == 0 and explored["acting"] == "stochastic" and not explored.is_of_the_benchmark
    status, _, [_, acted] = evaluate()
    assert status == 0 and acted["acting"] == "" and acted.is_of_the_benchmark
    assert standard(acted) and not standard(explored)


def test_an_agent_of_another_task_has_a_row_that_says_so(evaluate: Any) -> None:
    status, said, [row] = evaluate("--env-kwargs", "task=walk")
    assert status == 0 and "The agent has learnt walker-run, and plays walker-walk" in said and "Dreamer@2M" not in said
    assert (row.task, row["learnt_task"]) == ("walk", "walker-run") and not standard(row)
    status, said, [_, row] = evaluate()
    assert status == 0 and "has learnt" not in said and row["learnt_task"] == "" and standard(row)


def test_what_was_learnt_is_the_task_of_the_fine_tuning(tiny_model: Any, tmp_path: Path) -> None:
    def env(task: str) -> CounterEnv:
        return CounterEnv(5, **{**WALKER, "task": task})

    model = tiny_model(env("stand"), intrinsic_reward="lbs").learn(10)
    assert model.learnt_task is None
    model.fine_tune(env("run"))
    assert model.learnt_task is None
    model.learn(10).save(tmp_path / "model")
    assert model.learnt_task == "walker-run"
    loaded = DreamerV2.load(tmp_path / "model", env=env("walk"))
    assert loaded.learnt_task == "walker-run"
    assert loaded.learn(10).learnt_task == "walker-walk"


@pytest.mark.parametrize("arguments", [("--episodes", "3"), ("--seed", "7")])
def test_a_row_that_will_be_refused_is_told_before_the_first_episode(
    evaluate: Any, arguments: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert evaluate()[0] == 0
    monkeypatch.setattr(DreamerV2, "predict", None)
    status, said, rows = evaluate(*arguments)
    assert status == 2 and "holds another result of the same run" in said and len(rows) == 1


def test_a_result_that_is_refused_ends_nothing_else(tiny_model: Any, tmp_path: Path, capsys: Any) -> None:
    model = tiny_model(CounterEnv(20, **WALKER), planner="dyna_mpc", seed=0)
    model.save(tmp_path / "agent")
    command = ["evaluate", str(tmp_path / "agent.zip"), "--env", "Counter-v0", "--episodes", "1", "--device", "cpu"]
    command += ["--rows", str(tmp_path / "rows.csv"), "--npz", str(tmp_path)]
    assert main([*command, "--planner", "on"]) == 0
    text = (tmp_path / "rows.csv").read_text()
    [row] = read_rows(tmp_path / "rows.csv").rows
    (tmp_path / "rows.csv").write_text(text.replace(f",{row.return_mean},", f",{row.return_mean + 1},"))
    (tmp_path / "evaluations.npz").unlink()
    assert main([*command, "--planner", "both"]) == 2
    said = capsys.readouterr()
    assert "holds another result of the same run" in said.err and "actor alone" in said.out
    assert [row.planner for row in read_rows(tmp_path / "rows.csv").rows] == ["dyna_mpc", "none"]
    assert (tmp_path / "evaluations.npz").exists()


def test_a_runs_own_evaluations_are_not_replaced(evaluate: Any, tmp_path: Path) -> None:
    folder = tmp_path / "npz"
    assert evaluate("--npz", str(folder))[0] == 0
    assert evaluate("--npz", str(folder))[0] == 0  # the same once more
    for content in ({"timesteps": np.array([4, 10])}, {"steps": np.array([4])}):
        np.savez(folder / "evaluations.npz", **content)
        before = (folder / "evaluations.npz").read_bytes()
        status, said, _ = evaluate("--npz", str(folder))
        assert status == 2 and "give another folder" in said and (folder / "evaluations.npz").read_bytes() == before
