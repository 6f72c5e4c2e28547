"""Runs that go on: bit for bit on the CPU, after kill -9 at any moment, after signals, beside another run, on a full disk."""

from __future__ import annotations

import hashlib
import os
import random
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch as th
from fake_envs import CounterEnv
from places import PYTHONPATH
from stable_baselines3.common.callbacks import ConvertCallback, EvalCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv
from whole_runs import LENGTH, RepeatingEnv, SmallDisk, crash, everything, scramble, vec_env

from sb3_dreamer_urlb import DreamerV2, PhaseSwitchCallback, RunCheckpointCallback, SnapshotError
from sb3_dreamer_urlb.runs.run_folder import RunFolder


def close(model):
    """What the end of a process does to a replay on disk."""
    if model.replay_buffer.disk is not None:
        model.replay_buffer.disk.close()


LMDB = {"replay_buffer_kwargs": {"store": "lmdb", "path": "replay"}}
CASES = [
    ("lbs", 2, {}, 0),
    (None, 1, {"planner": "dyna_mpc"}, 0),
    ("lbs", 1, {"buffer_size": 70}, 0),
    ("lbs", 1, {"buffer_size": 70, **LMDB}, 80),
]


# -- bit for bit -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("method", "n_envs", "kwargs", "beyond"), CASES)
def test_400_steps_are_200_and_a_resume_and_200(tiny_model, tmp_path, monkeypatch, method, n_envs, kwargs, beyond):
    """``beyond``: steps after the checkpoint, of which nothing may be left, in a full replay neither."""

    def start(folder):
        (tmp_path / folder).mkdir()
        monkeypatch.chdir(tmp_path / folder)
        scramble()
        return tiny_model(vec_env(n_envs), intrinsic_reward=method, **kwargs)

    whole = start("whole").learn(400)
    expected = everything(whole)
    model = start("cut").learn(200, callback=RunCheckpointCallback("run", 60))
    model.learn(beyond, reset_num_timesteps=False)
    close(model)
    scramble()
    model = DreamerV2.resume("run", vec_env(n_envs), device="cpu")
    assert model.num_timesteps == 200 and model._n_updates > 0
    model.learn(200, reset_num_timesteps=False, callback=RunCheckpointCallback("run", 60))
    found = everything(model)
    assert {name for name in expected if found[name] != expected[name]} == set()


def test_400_steps_are_200_and_save_and_load_and_200(tiny_model, tmp_path):
    """A snapshot and a replay file do what a run folder does."""
    expected = everything(tiny_model(vec_env(), intrinsic_reward="lbs").learn(400))
    model = tiny_model(vec_env(), intrinsic_reward="lbs").learn(200)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "replay")
    scramble()
    loaded = DreamerV2.load(tmp_path / "model", env=vec_env(), device="cpu")
    loaded.load_replay_buffer(tmp_path / "replay")
    found = everything(loaded.learn(200, reset_num_timesteps=False))
    assert {name for name in expected if found[name] != expected[name]} == set()


@pytest.mark.parametrize("n_envs", [1, 2])
def test_an_open_episode_is_ended_as_truncated(tiny_model, tmp_path, n_envs):
    reference = tiny_model(vec_env(n_envs), intrinsic_reward="lbs").learn(112)
    reference._last_obs = None  # a reset
    reference.env.envs[0].reset()
    expected = everything(reference.learn(80, reset_num_timesteps=False))
    tiny_model(vec_env(n_envs), intrinsic_reward="lbs").learn(112, callback=RunCheckpointCallback(tmp_path, 30))
    scramble()
    model = DreamerV2.resume(tmp_path, vec_env(n_envs), device="cpu")
    ends = [episode.is_terminal.any() for episode in model.replay_buffer.episodes]
    assert not any(ends) and model.replay_buffer.open == [None] * n_envs
    assert len(model.replay_buffer.episodes[-1]) == 112 // n_envs % LENGTH + 1
    found = everything(model.learn(80, reset_num_timesteps=False))
    assert {name for name in expected if found[name] != expected[name]} == set()


def test_a_resumed_environment_does_not_replay_the_first_resets(tiny_model, tmp_path):
    seeds = []

    class Env(CounterEnv):
        def reset(self, *, seed=None, options=None):
            seeds.append(seed)
            return super().reset(seed=seed, options=options)

    tiny_model(Env(LENGTH), seed=7).learn(40, callback=RunCheckpointCallback(tmp_path))
    DreamerV2.resume(tmp_path, Env(LENGTH)).learn(20, reset_num_timesteps=False)
    first, second = (seed for seed in seeds if seed is not None)
    assert first == 7 and second != 7


# -- the folder ------------------------------------------------------------------------------------------------------------


def test_a_run_killed_at_its_very_beginning_is_the_run_itself(tiny_model, tmp_path):
    """Its first episodes, too, are those that its seed begins."""

    class Seeded(RepeatingEnv):
        """Its rewards are its seed's."""

        def step(self, action):
            seen, _, *ends = super().step(action)
            return seen, float(self.np_random.random()), *ends

    def run(folder, steps, until=None):
        scramble()
        model = tiny_model(DummyVecEnv([lambda: Monitor(Seeded(20))]), seed=5)
        callbacks = [RunCheckpointCallback(tmp_path / folder, 10**6, resume="auto")]
        if until is not None:
            crash(model, until, steps, callbacks)
        return model if until is not None else model.learn(steps, callback=callbacks)

    expected = everything(run("whole", 60))
    run("cut", 60, until=30)
    assert everything(run("cut", 60)) == expected


def test_nothing_to_resume(tmp_path):
    assert DreamerV2.resume(tmp_path / "new", vec_env()) is None
    assert not (tmp_path / "new").exists()


def test_only_what_the_checkpoint_names_is_kept(tiny_model, tmp_path):
    model = tiny_model(vec_env(), buffer_size=50)
    sizes = []

    class Spy(RunCheckpointCallback):
        def _save(self):
            super()._save()
            sizes.append(len(list((tmp_path / "replay").iterdir())) if (tmp_path / "replay").exists() else 0)

    model.learn(400, callback=Spy(tmp_path, 20))
    assert len(sizes) > 15 and max(sizes) <= 4  # 50 rows are two episodes of 21, the open one, and one checkpoint's delay
    resumed = DreamerV2.resume(tmp_path, vec_env())
    assert [len(e) for e in resumed.replay_buffer.episodes] == [len(e) for e in model.replay_buffer.episodes]
    assert resumed.replay_buffer.evicted == model.replay_buffer.evicted > 10


def test_a_fine_tuning_inherits_no_replay(tiny_model, tmp_path):
    callbacks = [PhaseSwitchCallback(100), RunCheckpointCallback(tmp_path, 20)]
    model = tiny_model(vec_env(rewards=[1.0]), intrinsic_reward="lbs").learn(160, callback=callbacks)
    assert model.phase == "finetuning"
    resumed = DreamerV2.resume(tmp_path, vec_env(rewards=[1.0]))
    assert resumed.phase == "finetuning" and resumed.replay_buffer.phase == "finetuning"
    assert len(resumed.replay_buffer.episodes) == 3 and resumed.phase_timesteps == 60
    # Not even if the files of the other phase are put in the place of its own.
    tiny_model(vec_env(), intrinsic_reward="lbs").learn(60).save_replay_buffer(tmp_path / "foreign.zip")
    for file in (tmp_path / "replay").iterdir():
        os.replace(tmp_path / "foreign.zip", file)
        break
    with pytest.raises(SnapshotError, match=r"'pretraining'.*'finetuning'"):
        DreamerV2.resume(tmp_path, vec_env())


def test_a_run_resumed_after_the_switch_goes_on_in_the_tasks_environment(tiny_model, tmp_path):
    task = vec_env(rewards=[5.0])
    switch = PhaseSwitchCallback(60, task)
    tiny_model(vec_env(), intrinsic_reward="lbs").learn(100, callback=[switch, RunCheckpointCallback(tmp_path)])
    model = DreamerV2.resume(tmp_path, vec_env())
    model.learn(40, reset_num_timesteps=False, callback=[PhaseSwitchCallback(60, task), RunCheckpointCallback(tmp_path)])
    rewards = {float(r) for episode in model.replay_buffer.episodes for r in episode.reward[1:]}
    assert rewards == {5.0} and model.phase_timesteps == 80


def test_the_same_model_may_learn_again(tiny_model, tmp_path):
    model = tiny_model(vec_env()).learn(40, callback=RunCheckpointCallback(tmp_path))
    model.learn(40, reset_num_timesteps=False, callback=RunCheckpointCallback(tmp_path))
    assert DreamerV2.resume(tmp_path, vec_env()).num_timesteps == 80


def test_another_run_in_the_folder_is_refused(tiny_model, tmp_path):
    tiny_model(vec_env()).learn(40, callback=RunCheckpointCallback(tmp_path))
    before = (tmp_path / "snapshot.zip").read_bytes()
    with pytest.raises(ValueError, match=r"holds another run.*resume"):
        tiny_model(vec_env()).learn(40, callback=RunCheckpointCallback(tmp_path))
    assert (tmp_path / "snapshot.zip").read_bytes() == before


def test_two_writers(tiny_model, tmp_path):
    with RunFolder(tmp_path).locked():
        with pytest.raises(RuntimeError, match=f"Another run .process {os.getpid()}. is in"):
            tiny_model(vec_env()).learn(40, callback=RunCheckpointCallback(tmp_path))
        assert not (tmp_path / "snapshot.zip").exists()
    model = tiny_model(vec_env()).learn(20, callback=RunCheckpointCallback(tmp_path))
    with RunFolder(tmp_path).locked(), pytest.raises(RuntimeError, match="Another run"):
        DreamerV2.resume(tmp_path, vec_env())
    # An error in learn gives the folder back, and the signals.
    with pytest.raises(ZeroDivisionError):
        model.learn(
            20, callback=[RunCheckpointCallback(tmp_path), ConvertCallback(lambda *_: 1 / 0)], reset_num_timesteps=False
        )
    with RunFolder(tmp_path).locked():
        assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


def test_the_best_evaluation_is_remembered(tiny_model, tmp_path):
    def evaluation():
        return EvalCallback(vec_env(), eval_freq=20, n_eval_episodes=1, verbose=0, warn=False)

    first = evaluation()
    tiny_model(vec_env()).learn(60, callback=[first, RunCheckpointCallback(tmp_path, evaluation=first)])
    second = evaluation()
    model = DreamerV2.resume(tmp_path, vec_env())
    assert second.best_mean_reward == -np.inf
    model.learn(4, callback=[second, RunCheckpointCallback(tmp_path, evaluation=second)], reset_num_timesteps=False)
    assert second.best_mean_reward == first.best_mean_reward > 0 and second.n_calls == 64


@pytest.mark.parametrize("damage", ["replay", "snapshot", "missing"])
def test_a_damaged_folder_is_refused(tiny_model, tmp_path, damage):
    tiny_model(vec_env()).learn(60, callback=RunCheckpointCallback(tmp_path))
    file = tmp_path / "snapshot.zip" if damage == "snapshot" else next((tmp_path / "replay").iterdir())
    if damage == "missing":
        file.unlink()
    else:
        content = bytearray(file.read_bytes())
        content[len(content) // 2] ^= 1
        file.write_bytes(content)
    with pytest.raises(SnapshotError if damage != "missing" else FileNotFoundError, match=file.name):
        DreamerV2.resume(tmp_path, vec_env())


@pytest.mark.parametrize("frames", [0, -1])
def test_frames_must_be_positive(tmp_path, frames):
    with pytest.raises(ValueError, match=f"every_frames must be an integer of at least 1, got {frames}"):
        RunCheckpointCallback(tmp_path, frames)


# -- processes that end ----------------------------------------------------------------------------------------------------


def a_run(folder: str, total: int, pause: float = 0.0) -> None:
    """What the subprocesses below do: begin or go on, then print a digest of everything."""
    th.set_num_threads(1)
    env = vec_env()
    model = DreamerV2.resume(folder, env, device="cpu")
    if model is None:
        random.seed(0)
        model = DreamerV2("CnnPolicy", env, intrinsic_reward="lbs", preset="tiny", seed=0, device="cpu", buffer_size=200)
    print("started", flush=True)

    def slow(*_):
        time.sleep(pause)
        return True

    # An episode ends wherever a checkpoint is due, so that nothing is lost of an open one.
    callbacks = [RunCheckpointCallback(folder, LENGTH), ConvertCallback(slow)]
    model.learn(total - model.num_timesteps, callback=callbacks, reset_num_timesteps=False)
    print(hashlib.sha256(repr(sorted(everything(model).items())).encode()).hexdigest())


def spawn(folder: Path, total: int, pause: float = 0.0) -> subprocess.Popen:
    code = f"import test_run_folder as t; t.a_run({str(folder)!r}, {total}, {pause})"
    path = PYTHONPATH
    environment = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    return subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment)


def test_kill_at_random_moments_changes_nothing(tmp_path):
    """The run that was killed again and again ends with the same bits as the one that was not."""
    total = 200
    whole, _ = spawn(tmp_path / "whole", total).communicate()
    generator = np.random.default_rng(0)
    kills = 0
    for _ in range(40):
        process = spawn(tmp_path / "killed", total, 0.003)
        process.stdout.readline()
        try:
            out, err = process.communicate(timeout=generator.uniform(0.1, 0.9) if kills < 4 else None)
            break
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()
            kills += 1
    assert process.returncode == 0, err.decode()
    assert kills >= 3 and out.split()[-1] == whole.split()[-1]


def test_sigterm_finishes_the_step_saves_and_exits(tmp_path):
    process = spawn(tmp_path, 10_000, 0.02)
    process.stdout.readline()
    time.sleep(1.5)
    process.send_signal(signal.SIGTERM)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGTERM, err.decode()
    model = DreamerV2.resume(tmp_path, vec_env())
    # More than the last checkpoint at a multiple of the episode's length.
    assert 0 < model.num_timesteps < 10_000 and model._n_updates > 0


def test_the_second_signal_exits_at_once(tmp_path):
    process = spawn(tmp_path, 10_000, 30.0)  # a step that takes half a minute
    process.stdout.readline()
    time.sleep(1.0)
    process.send_signal(signal.SIGINT)
    time.sleep(0.5)
    assert process.poll() is None
    process.send_signal(signal.SIGINT)
    before = time.time()
    process.communicate(timeout=60)
    assert time.time() - before < 5 and process.returncode == -signal.SIGINT


def test_sigint_raises_keyboard_interrupt(tiny_model, tmp_path):
    def interrupt(local, _):
        if local["self"].num_timesteps == 50:
            os.kill(os.getpid(), signal.SIGINT)
        return True

    with pytest.raises(KeyboardInterrupt):
        tiny_model(vec_env()).learn(400, callback=[RunCheckpointCallback(tmp_path), ConvertCallback(interrupt)])
    assert DreamerV2.resume(tmp_path, vec_env()).num_timesteps in (50, 51)


class SmallFiles:
    """A limit of the process on the size of its files."""

    def __init__(self, folder):
        self.folder = folder
        self.before = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill(self):
        resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, self.before[1]))

    def free(self):
        resource.setrlimit(resource.RLIMIT_FSIZE, self.before)

    close = free


@pytest.mark.parametrize(("make", "reason"), [(SmallDisk, "No space left"), (SmallFiles, "File too large")])
def test_a_full_disk_leaves_the_last_checkpoint(tiny_model, tmp_path, make, reason):
    disk = make(tmp_path)
    run = disk.folder / "run"
    try:
        model = tiny_model(vec_env()).learn(60, callback=RunCheckpointCallback(run))
        expected = {name: value for name, value in everything(model).items() if name in ("weights", "moments", "counters")}
        disk.fill()
        with pytest.raises(OSError, match=rf"{reason}.*intact.*{run}"):
            model.learn(60, callback=RunCheckpointCallback(run, 20), reset_num_timesteps=False)
        assert not list(run.rglob("*.tmp"))
        resumed = DreamerV2.resume(run, vec_env(), device="cpu")
        assert {name: everything(resumed)[name] for name in expected} == expected
        disk.free()
        resumed.learn(60, callback=RunCheckpointCallback(run, 20), reset_num_timesteps=False)
        assert DreamerV2.resume(run, vec_env()).num_timesteps == 120
    finally:
        disk.close()


def test_resume_wants_a_folder(tmp_path):
    (tmp_path / "model.zip").touch()
    with pytest.raises(NotADirectoryError, match=r"got the file .*model\.zip"):
        DreamerV2.resume(tmp_path / "model.zip")
