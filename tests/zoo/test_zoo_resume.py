"""Runs of rl_zoo3 that go on: after kill -9, by their folder (``-i``) or of themselves (``resume: auto``)."""

from __future__ import annotations

import contextlib
import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from unittest import mock

import gymnasium
import numpy as np
import pandas
import pytest
import yaml
from gymnasium.envs.registration import EnvSpec
from places import PYTHONPATH
from stable_baselines3.common.monitor import load_results
from stable_baselines3.common.vec_env import DummyVecEnv
from whole_runs import RepeatingEnv, everything
from zoo_commands import CONFIGS, FLIP, STAND, TINY, TRAIN, latest_run, model_in, train

from sb3_dreamer_urlb import DreamerV2, RunCheckpointCallback
from sb3_dreamer_urlb.runs.run_folder import CHECKPOINT, RunFolder, steps_done
from sb3_dreamer_urlb.zoo import resuming
from sb3_dreamer_urlb.zoo.__main__ import main
from sb3_dreamer_urlb.zoo.monitor_files import put_monitor_files_aside

#: two frames a step: a checkpoint whenever an episode of 20 steps ends
EVERY = "checkpoint:dict(every_frames=40)"
REPEATING = {"length": 20, "action_repeat": 2, "domain": "walker"}


class SlowEnv(RepeatingEnv):
    """Takes its time where the environment variable says so, so that a kill comes in the middle."""

    def step(self, action):
        time.sleep(float(os.environ.get("SECONDS_A_STEP", "0")))
        return super().step(action)


SLOW_WALKERS = f"""
import gymnasium
import sb3_dreamer_urlb
gymnasium.registry[{STAND!r}].entry_point = "test_zoo_resume:SlowEnv"
gymnasium.registry[{STAND!r}].kwargs = {REPEATING!r}
"""


@pytest.fixture
def repeating(zoo, monkeypatch):
    """The zoo, with an environment in which a reset forgets nothing."""
    for name in (STAND, FLIP):
        monkeypatch.setitem(gymnasium.registry, name, EnvSpec(name, SlowEnv, kwargs=REPEATING))
    return zoo


@pytest.fixture
def crashing(monkeypatch):
    """Let a run end with an error after some steps of it."""
    original = DreamerV2.train

    def at(steps: int | None) -> None:
        def train_or_crash(model, *args, **kwargs):
            if steps is not None and model.num_timesteps >= steps:
                raise ZeroDivisionError
            original(model, *args, **kwargs)

        monkeypatch.setattr(DreamerV2, "train", train_or_crash)

    return at


def crashed(crashing, steps, *arguments, **kwargs):
    """The folder of a run that crashed."""
    crashing(steps)
    with pytest.raises(ZeroDivisionError):
        train(*arguments, **kwargs)
    crashing(None)
    return latest_run(arguments[1])


def kill_when(folder: Path, arguments: list[str], run: Path, steps: int) -> None:
    """Start the command in a process of its own, and kill it when a checkpoint is of so many steps."""
    paths = [PYTHONPATH]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": "1", "SECONDS_A_STEP": "0.02"}
    process = subprocess.Popen(
        [sys.executable, "-m", "sb3_dreamer_urlb.zoo", *arguments], cwd=folder, env=env, stdout=subprocess.DEVNULL
    )
    deadline = time.monotonic() + 250
    while not (resuming.has_checkpoint(run) and steps_done(run / CHECKPOINT) >= steps):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.05)
    time.sleep(0.1)  # somewhere after it
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL


def test_kill_9_in_both_phases_changes_nothing(repeating, tmp_path):
    """The command is typed whole once, then ``-i`` says it all; what comes out is what an undisturbed run gives."""
    (tmp_path / "custom_envs.py").write_text(SLOW_WALKERS)
    config = ["-conf", str(CONFIGS / "lbs.yml"), "--eval-freq", "30", "--eval-episodes", "1", "--save-freq", "50"]
    command = [*TRAIN, "--env", STAND, "-n", "160", *config, "-params", *TINY[:1], EVERY]
    command.append(TINY[1].replace("[40, 80]", "[80, 160]").replace("pretrain_frames=80", "pretrain_frames=160"))
    run = Path("logs/dreamerv2/urlb-walker-stand-v0_1")
    kill_when(tmp_path, command, tmp_path / run, 40)
    go_on = ["train", "--algo", "dreamerv2", "--env", STAND, "-i", str(run)]
    kill_when(tmp_path, go_on, tmp_path / run, 100)
    repeating(*go_on)
    assert [path.name for path in run.parent.iterdir()] == [run.name]
    (tmp_path / "whole").mkdir()
    os.chdir(tmp_path / "whole")
    repeating(*command)
    os.chdir(tmp_path)
    whole = Path("whole") / run
    for name in ("urlb-walker-stand-v0.zip", "snapshots/snapshot_80.zip", "snapshots/snapshot_160.zip", "best_model.zip"):
        mine, its = (everything(DreamerV2.load(folder / name, device="cpu")) for folder in (run, whole))
        assert mine["weights"] == its["weights"] and mine["counters"] == its["counters"], name
    model = DreamerV2.resume(run / "checkpoint", DummyVecEnv([lambda: SlowEnv(20)]), device="cpu")
    reference = DreamerV2.resume(whole / "checkpoint", DummyVecEnv([lambda: SlowEnv(20)]), device="cpu")
    mine, its = everything(model), everything(reference)
    assert {name for name in its if mine[name] != its[name]} == set()
    assert (model.num_timesteps, model.phase, model.phase_timesteps) == (160, "finetuning", 80)
    results = [np.load(folder / "evaluations.npz") for folder in (run, whole)]
    assert all((results[0][name] == results[1][name]).all() for name in ("timesteps", "results", "ep_lengths"))
    assert results[0]["timesteps"].tolist() == [30, 60, 90, 120, 150]
    assert {path.name for path in run.glob("rl_model*")} == {f"rl_model_{n}_steps.zip" for n in (50, 100, 150)}
    # Every episode once, in order.
    assert load_results(str(run))["l"].tolist() == load_results(str(whole))["l"].tolist() == [20] * 8
    assert len(list(run.glob("*.monitor.csv"))) == 3


# -- which run, and with which options -------------------------------------------------------------------------------------


def test_a_finished_run_may_become_longer(repeating):
    run = train(repeating, STAND, 24, "lbs", params=[*TINY, EVERY])
    repeating("train", "--algo", "dreamerv2", "-i", f"{run}/checkpoint/snapshot.zip", "--env", STAND, "-n", "40")
    model = model_in(latest_run(STAND))
    assert latest_run(STAND) == run and (model.num_timesteps, model.phase_frames) == (40, 80)
    assert yaml.safe_load((CONFIGS / "lbs.yml").read_text())[STAND].keys().isdisjoint({"resume", "checkpoint"})


def test_a_fine_tuning_that_crashed_goes_on(repeating, crashing):
    pretrained = train(repeating, STAND, 40, "lbs", params=TINY) / "snapshots" / "snapshot_80.zip"
    run = crashed(
        crashing, 25, repeating, FLIP, 60, "finetune", "-i", str(pretrained), params=["checkpoint:dict(every_frames=20)"]
    )
    assert 0 < steps_done(run / "checkpoint") < 60
    repeating("train", "--algo", "dreamerv2", "--env", FLIP, "-i", str(run))
    model = model_in(run, FLIP)
    assert (model.phase, model.phase_timesteps, model.planner) == ("finetuning", 60, "dyna_mpc")


class Killed(BaseException):
    """In whose place a process would end: nobody tidies up."""


def killed(*_, **__):
    raise Killed


def test_a_run_that_never_came_to_a_checkpoint_begins_again(repeating, monkeypatch, capsys):
    with monkeypatch.context() as patch:
        patch.setattr(DreamerV2, "learn", killed)
        with pytest.raises(Killed):
            train(repeating, STAND, 20, "lbs", params=TINY)
    run = latest_run(STAND)
    repeating("train", "--algo", "dreamerv2", "--env", STAND, "-i", str(run))
    assert "has no checkpoint yet" in capsys.readouterr().out
    assert latest_run(STAND) == run and model_in(run).num_timesteps == 20 and model_in(run).seed == 1


@pytest.mark.parametrize("how", ["-i auto", "resume: auto"])
def test_auto_goes_on_with_the_run_of_this_command(repeating, crashing, how, capsys):
    """The newest of the same configuration and seed that is not finished; a new one where there is none."""
    more = ["-i", "auto"] if how == "-i auto" else []
    params = [*TINY, EVERY, *([] if more else ["resume:'auto'"])]
    first = crashed(crashing, 30, repeating, STAND, 60, "lbs", *more, params=params)
    assert "a new one begins" in capsys.readouterr().out
    other = crashed(crashing, 30, repeating, STAND, 60, "lbs", *more, params=[*params, "batch_size:3"])
    assert other != first
    other_seed = crashed(crashing, 30, repeating, STAND, 60, "lbs", "--seed", "5", *more, params=params)
    assert other_seed not in (first, other)
    with RunFolder(first / "checkpoint").locked():
        assert resuming.is_going(first)
    train(repeating, STAND, 60, "lbs", *more, params=params)
    assert model_in(first).num_timesteps == 60 and not (other / "urlb-walker-stand-v0.zip").exists()
    assert latest_run(STAND) == other_seed
    train(repeating, STAND, 60, "lbs", *more, params=params)
    assert latest_run(STAND) not in (first, other, other_seed)


def test_mistakes_are_named(repeating, tmp_path, capsys):
    run = train(repeating, STAND, 8, "lbs", params=TINY)
    with pytest.raises(SystemExit):
        main(["train", "--algo", "dreamerv2", "--env", FLIP, "-i", str(run)])
    assert f"the run in {run} is --algo dreamerv2 --env {STAND}" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main(["train", "--algo", "dreamerv2", "--env", STAND, "-i", str(tmp_path)])
    assert "is not the folder of a run: expected one as rl_zoo3 makes them" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        train(repeating, STAND, 60, "lbs", "-i", "logs/misspelt")
    assert "-i logs/misspelt: there is none; expected the .zip of a snapshot, the folder of a run" in capsys.readouterr().err
    again = ["train", "--algo", "dreamerv2", "--env", STAND, "-i", str(run)]
    with RunFolder(run / "checkpoint").locked(), pytest.raises(SystemExit):
        repeating(*again)
    assert "Another process is at work in" in capsys.readouterr().err
    with pytest.raises(SystemExit):
        repeating(*again, "-n", "16", "-params", "preset:'small'")
    assert "was made with preset='tiny', the configuration says 'small'" in capsys.readouterr().err
    for params, message in {
        "resume:'yes'": "resume must be 'auto' or false, got 'yes'",
        "checkpoint:3": "checkpoint must be true, false or keyword arguments of RunCheckpointCallback, got 3",
    }.items():
        with pytest.raises(SystemExit):
            train(repeating, STAND, 8, "lbs", params=[*TINY, params])
        assert message in capsys.readouterr().err
    # No code runs from a run's folder.
    [args] = run.glob("*/args.yml")
    args.write_text("!!python/object/apply:os.system ['touch hacked']")
    with pytest.raises(SystemExit):
        main(again)
    assert "cannot be read" in capsys.readouterr().err and not Path("hacked").exists()


def test_a_run_without_checkpoints(repeating):
    run = train(repeating, STAND, 8, "lbs", params=[*TINY, "checkpoint:False"])
    assert not (run / "checkpoint").exists()


def test_ctrl_c_leaves_a_run_that_goes_on(repeating, monkeypatch):
    """The run is saved as rl_zoo3 saves it, and is not taken for finished."""
    original = DreamerV2.train

    def interrupted(model, *args, **kwargs):
        original(model, *args, **kwargs)
        if model.num_timesteps >= 30 and not model.run_folder.resumed:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(DreamerV2, "train", interrupted)
    params = [*TINY, "callback:[]"]  # ours is the only one, and rl_zoo3 ends the first one twice
    run = train(repeating, STAND, 60, "lbs", params=params)
    assert 30 <= model_in(run).num_timesteps < 60
    train(repeating, STAND, 60, "lbs", "-i", "auto", params=params)
    # Rollouts of five steps, of which the signal cut one short.
    assert latest_run(STAND) == run and 60 <= model_in(run).num_timesteps < 65


@pytest.fixture
def folder(tmp_path):
    """Of a run whose checkpoint was written 2000 seconds after 1970, whatever its file says."""
    (tmp_path / "checkpoint").mkdir()
    with mock.patch("time.time", lambda: 2000.0):
        model = DreamerV2("MlpPolicy", "CartPole-v1", preset="tiny", device="cpu")
        model.learn(4, callback=RunCheckpointCallback(tmp_path / "checkpoint"))
    return tmp_path


def monitor_file(rows, start=1000.0):
    return f"#{json.dumps({'t_start': start})}\nr,l,t\n{rows}"


@pytest.mark.parametrize("copied_at", [1, 1500, 10**9])
def test_monitor_files_lose_what_came_after_the_checkpoint(folder, copied_at):
    os.utime(folder / "checkpoint" / "snapshot.zip", (copied_at, copied_at))
    rows = "1.0,20,3.5\n2.0,20,999.0\n3.0,20,1001.0\n4.0,2"  # the last one cut off
    (folder / "0.monitor.csv").write_text(monitor_file(rows))
    (folder / "eval.monitor.csv").write_text("something else")
    put_monitor_files_aside(folder)
    assert not (folder / "0.monitor.csv").exists() and (folder / "eval.monitor.csv").exists()
    kept = pandas.read_csv(folder / "0.before_2000.monitor.csv", skiprows=1)
    assert kept["r"].tolist() == [1.0, 2.0] and kept["t"].tolist() == [3.5, 999.0]
    # Nothing is lost.
    assert (folder / "0.undone_2000").read_text().splitlines()[2:] == ["3.0,20,1001.0", "4.0,2"]


def test_monitor_files_of_two_tries_from_one_checkpoint_are_all_kept(folder):
    for reward in (1.0, 2.0, 3.0):
        (folder / "0.monitor.csv").write_text(monitor_file(f"{reward},20,3.5\n4.0,20,1002\n"))
        put_monitor_files_aside(folder)
    files = sorted(folder.glob("*.monitor.csv"))
    assert sorted(pandas.read_csv(file, skiprows=1)["r"].item() for file in files) == [1.0, 2.0, 3.0]
    assert len(list(folder.glob("0.undone_2000*"))) == 3


@pytest.mark.parametrize(
    ("text", "kept"),
    [
        ("#{'t_start'", None),
        ("#{}\nr,l,t\n1.0,20,3.5\n", None),
        ("#[1]\nr,l,t\n1.0,20,3.5\n", None),
        (monitor_file("5.0,5,abc\n1.0,20,3.5\n"), ["1.0,20,3.5"]),
        (monitor_file("5.0,5,4.5\0\n1.0,20,3.5\n"), ["5.0,5,4.5", "1.0,20,3.5"]),
        (f"#{json.dumps({'t_start': 1000.0})}\n", []),
    ],
)
def test_a_damaged_monitor_file_stops_no_run(folder, text, kept):
    (folder / "0.monitor.csv").write_text(text)
    with pytest.warns(UserWarning, match="0.monitor.csv cannot be read") if kept is None else contextlib.nullcontext():
        put_monitor_files_aside(folder)
    if kept is None:
        assert (folder / "0.damaged_2000").read_text() == text and not list(folder.glob("*.monitor.csv"))
    else:
        assert (folder / "0.before_2000.monitor.csv").read_text().splitlines()[2:] == kept


def test_a_run_keeps_what_it_began_with(repeating, tmp_path, capsys):
    config = tmp_path / "conf.yml"
    config.write_text(f"{STAND}:\n  policy: CnnPolicy\n  preset: tiny\n  n_timesteps: 24\n  batch_size: 2\n")
    command = ["train", "--algo", "dreamerv2", "--env", STAND, "-conf", str(config), "--seed", "3"]
    repeating(*command)
    run = latest_run(STAND)
    again = [*command[:5], "-i", str(run), "-n", "32"]
    other = tmp_path / "other.yml"
    other.write_text(config.read_text().replace("batch_size: 2", "batch_size: 3\n  learning_rate: 0.1"))
    for wrong, message in {
        (
            "-conf",
            str(other),
        ): "has batch_size=2, learning_rate=None, this configuration batch_size=3, learning_rate=0.1",
        ("--seed", "4"): f"the run in {run} has --seed 3, a run keeps it: --seed 4 is for another one",
        ("--env-kwargs", "length:9"): "has --env-kwargs None, a run keeps it: --env-kwargs {'length': 9} is for another one",
    }.items():
        with pytest.raises(SystemExit):
            repeating(*again, *wrong)
        assert message in " ".join(capsys.readouterr().err.split())
    assert model_in(run).num_timesteps == 24
    repeating(*again[:-2])
    assert "has done 24 of 24 steps: -n makes it longer" in capsys.readouterr().out
    repeating(*again, "-conf", str(config), "--seed", "3")
    assert model_in(run).num_timesteps == 32
    # The advice of a damaged file works.
    [args] = run.glob("*/args.yml")
    args.write_text("")
    with pytest.warns(UserWarning, match="args.yml cannot be read.*The options of this command count"):
        repeating(*again[:-1], "40", "-conf", str(config), "--seed", "3")
    assert model_in(run).num_timesteps == 40


def test_a_damaged_run_is_passed_over(repeating, crashing):
    params = [*TINY, EVERY]
    first = crashed(crashing, 30, repeating, STAND, 60, "lbs", "-i", "auto", params=params)
    second = crashed(crashing, 30, repeating, STAND, 60, "lbs", "-i", "auto", "--seed", "5", params=params)
    (second / "checkpoint" / "snapshot.zip").write_bytes(b"damaged")
    with pytest.warns(UserWarning, match=f"{second} is passed over"):
        train(repeating, STAND, 60, "lbs", "-i", "auto", params=params)
    assert model_in(first).num_timesteps == 60


# -- trials that learn nothing ---------------------------------------------------------------------------------------------


def test_optimize_prunes_a_trial_whose_updates_are_not_finite(repeating, monkeypatch):
    """Such updates are skipped, and twenty in a row are a ValueError, on which rl_zoo3 prunes."""
    original, trials = DreamerV2.train, []

    def spoilt(model, *args, **kwargs):
        if model not in trials:
            trials.append(model)
            if len(trials) == 1:
                loss = model.learner.agent.critic.loss
                model.learner.agent.critic.loss = lambda *values: loss(*values) * math.nan
        original(model, *args, **kwargs)

    monkeypatch.setattr(DreamerV2, "train", spoilt)
    monkeypatch.setitem(gymnasium.registry, STAND, EnvSpec(STAND, SlowEnv, kwargs={**REPEATING, "length": 60}))
    search = ["-optimize", "--n-trials", "2", "--n-evaluations", "1", "--eval-episodes", "1", "--no-optim-plots"]
    # The first trial draws train_freq=2 and batch_length=50, the second train_freq=10.
    train(repeating, STAND, 180, "scratch", *search, params=[TINY[0], "learning_starts:20"])
    [report] = Path("logs/dreamerv2").glob("report_*.csv")
    first, second = report.read_text().splitlines()[1:]
    assert "PRUNED" in first and "COMPLETE" in second and not list(Path().rglob("checkpoint"))
