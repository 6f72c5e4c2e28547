"""Updates while environments step: they really overlap, and nobody can tell from the result."""

from __future__ import annotations

import functools
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from fake_envs import CounterEnv
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnvWrapper, VecNormalize
from whole_runs import RepeatingEnv, everything, scramble

from sb3_dreamer_urlb import DreamerV2, PhaseSwitchCallback, RunCheckpointCallback
from sb3_dreamer_urlb.envs import EnvironmentFaultError, FaultGuard, SupervisedVecEnv
from sb3_dreamer_urlb.envs.faults import FAULT


class AnsweringEnv(CounterEnv):
    """Images and rewards tell all the actions of the episode; lengths are drawn. Seeds decide everything."""

    def reset(self, **kwargs):
        observation, info = super().reset(**kwargs)
        self.length, self.sum = int(self.np_random.integers(8, 15)), 0.0
        return observation * 0, info

    def step(self, action):
        observation, _, terminated, truncated, info = super().step(action)
        self.sum += float(np.abs(action).sum())
        observation[:] = int(1000 * self.sum) % 256
        return observation, self.sum % 1, terminated, truncated, info


class MeetingEnv(CounterEnv):
    """In every fifth step it looks for an update that is going on, and lets it know.

    :param folder: of the two files that say so
    :param seconds: to look
    """

    def __init__(self, folder, seconds):
        super().__init__(10)
        self.folder, self.seconds, self.steps = folder, seconds, 0

    def step(self, action):
        self.steps += 1
        met = False
        if self.steps % 5 == 0 and self.steps > 14:
            (self.folder / "step").touch()
            met = appears(self.folder / "update", self.seconds)
            (self.folder / "step met").touch()
        observation, _, terminated, truncated, info = super().step(action)
        return observation, float(met), terminated, truncated, info


class DyingEnv(CounterEnv):
    """Ends its process in step 7."""

    def step(self, action):
        if self.t == 6:
            os._exit(3)
        return super().step(action)


def appears(path: Path, seconds: float) -> bool:
    """Wait for a file."""
    end = time.monotonic() + seconds
    while not path.exists():
        if time.monotonic() > end:
            return False
        time.sleep(0.002)
    return True


def monitored(env, *args):
    return Monitor(env(*args))


def processes(env, *args, n_envs=1):
    return SubprocVecEnv([functools.partial(monitored, env, *args)] * n_envs, start_method="forkserver")


@pytest.fixture(scope="module")
def subproc():
    envs = {n: processes(AnsweringEnv, n_envs=n) for n in (1, 2)}
    yield envs
    for env in envs.values():
        env.close()


@pytest.fixture(scope="module")
def supervised():
    env = SupervisedVecEnv([functools.partial(monitored, AnsweringEnv)] * 2)
    yield env
    env.close()


# -- the same result -------------------------------------------------------------------------------------------------------


def results(tiny_model, env, overlap, steps=60, **kwargs):
    scramble()
    model = tiny_model(env, overlap=overlap, intrinsic_reward="lbs", **kwargs).learn(steps)
    assert model._n_updates > 3
    return {**everything(model), "log": [(info["r"], info["l"]) for info in model.ep_info_buffer]}


def differences(mine, its):
    return {name for name in mine if mine[name] != its[name]}


@pytest.mark.parametrize(
    ("n_envs", "kwargs"),
    [
        (1, {"train_freq": 1, "steps": 30}),
        (2, {"train_freq": 3, "gradient_steps": 2}),
        (2, {"train_freq": (4, "step"), "gradient_steps": -1}),
        (1, {"train_freq": (1, "episode"), "gradient_steps": 2}),
        (1, {"train_freq": 4, "action_noise": NormalActionNoise(np.zeros(2), np.ones(2))}),
    ],
)
def test_overlapped_and_plain_are_the_same_bits(tiny_model, subproc, n_envs, kwargs):
    plain = results(tiny_model, subproc[n_envs], False, **kwargs)
    assert differences(results(tiny_model, subproc[n_envs], True, **kwargs), plain) == set()
    # Without processes, too.
    alone = DummyVecEnv([functools.partial(monitored, AnsweringEnv)] * n_envs)
    assert differences(results(tiny_model, alone, True, **kwargs), plain) == set()


def test_the_comparison_sees_differences(tiny_model):
    mine, its = (results(tiny_model, DummyVecEnv([lambda: Monitor(AnsweringEnv())]), True, seed=seed) for seed in (0, 1))
    assert {"weights", "moments", "episodes", "log", "torch"} <= differences(mine, its)


def test_supervised_processes(tiny_model, supervised):
    assert differences(*[results(tiny_model, supervised, overlap) for overlap in (True, False)]) == set()


def test_normalised_rewards(tiny_model, subproc):
    """Statistics change with every step; an update sees those before the step, overlapped or not."""
    mine, its = (results(tiny_model, VecNormalize(subproc[2], norm_obs=False), overlap) for overlap in (True, False))
    assert differences(mine, its) == set()


def test_a_switch_of_phases(tiny_model, subproc):
    found = []
    for overlap in (True, False):
        scramble()
        model = tiny_model(subproc[1], overlap=overlap, intrinsic_reward="lbs", planner="dyna_mpc")
        model.learn(130, callback=PhaseSwitchCallback(60, subproc[1]))
        assert model.phase == "finetuning" and model.phase_updates > 0
        found.append(everything(model))
    assert differences(*found) == set()


def test_a_resumed_run_is_bit_for_bit(tiny_model, tmp_path):
    env = processes(RepeatingEnv, 20)
    try:
        scramble()
        expected = everything(tiny_model(env, intrinsic_reward="lbs").learn(120))
        tiny_model(env, intrinsic_reward="lbs").learn(60, callback=RunCheckpointCallback(tmp_path / "run", 20))
        scramble()
        model = DreamerV2.resume(tmp_path / "run", env, device="cpu")
        assert model.overlap and model.num_timesteps == 60
        assert differences(everything(model.learn(60, reset_num_timesteps=False)), expected) == set()
    finally:
        env.close()


# -- at the same time ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("overlap", [True, False])
def test_a_step_and_an_update_meet(tiny_model, monkeypatch, tmp_path, overlap):
    """Each waits for a sign of the other: neither could come after the other has ended."""
    seconds = 60.0 if overlap else 0.2
    env = processes(MeetingEnv, tmp_path, seconds)
    try:
        model = tiny_model(env, overlap=overlap, train_freq=5, learning_starts=14)
        original, met = model.learner.update, []

        def update(batch):
            (tmp_path / "update").touch()
            met.append(appears(tmp_path / "step", seconds) and appears(tmp_path / "step met", seconds))
            for file in tmp_path.iterdir():
                file.unlink()
            return original(batch)

        monkeypatch.setattr(model.learner, "update", update)
        model.learn(30)
    finally:
        env.close()
    rewards = np.concatenate([episode.rows(1, 11)["reward"] for episode in model.replay_buffer.episodes])
    # Taking turns, the update finds what the last step, long over, left there.
    assert met == ([True] * 4 if overlap else [False, True, True, True])
    assert np.flatnonzero(rewards).tolist() == ([14, 19, 24, 29] if overlap else [])


class Diary(VecEnvWrapper):
    """Notes what happens."""

    def __init__(self, venv, events):
        super().__init__(venv)
        self.events = events

    def reset(self):
        return self.venv.reset()

    def step_async(self, actions):
        self.events.append("send")
        self.venv.step_async(actions)

    def step_wait(self):
        self.events.append("wait")
        return self.venv.step_wait()


class DiaryCallback(BaseCallback):
    """Notes what happens, too."""

    def __init__(self, events, last=10**9):
        super().__init__()
        self.events, self.last = events, last

    def _on_rollout_start(self):
        self.events.append("start")

    def _on_step(self):
        assert self.n_calls + 12 == self.num_timesteps == self.model.num_timesteps == self.model.phase_timesteps
        self.events.append("step")
        return self.num_timesteps < self.last

    def _on_rollout_end(self):
        self.events.append("end")


def events_of(tiny_model, monkeypatch, steps, callback=None, **kwargs):
    """From step 12 on, when updates have begun."""
    events = []
    env = Diary(DummyVecEnv([lambda: Monitor(CounterEnv(6))]), events)
    model = tiny_model(env, **{"train_freq": 2, **kwargs}).learn(12)
    original = model.learner.update
    monkeypatch.setattr(model.learner, "update", lambda batch: events.append("update") or original(batch))
    events.clear()
    model.learn(steps, callback=callback or DiaryCallback(events), reset_num_timesteps=False)
    return model, events


PLAIN, LAST, TAKING_TURNS = "send wait step", "send update wait step", "update send wait step"


@pytest.mark.parametrize(
    ("kwargs", "rollout"),
    [
        ({}, f"start {PLAIN} {LAST} end"),
        ({"overlap": False}, f"start {PLAIN} {TAKING_TURNS} end"),
        ({"gradient_steps": 2}, f"start {PLAIN} {LAST.replace('update', 'update update')} end"),
        ({"gradient_steps": 0}, f"start {PLAIN} {PLAIN} end"),
        ({"train_freq": (1, "episode")}, f"start {' '.join([PLAIN] * 6)} end update"),
    ],
)
def test_the_order_of_things(tiny_model, monkeypatch, kwargs, rollout):
    _, events = events_of(tiny_model, monkeypatch, 12, **kwargs)
    assert " ".join(events) == " ".join([rollout] * (2 if "episode" in str(kwargs) else 6))


def test_the_weights_that_act_are_those_of_sb3s_order(tiny_model, monkeypatch):
    """All updates of earlier rollouts have happened when a rollout's actions are chosen, none of its own."""
    model = tiny_model(CounterEnv(6), train_freq=3, learning_starts=6)
    seen = []
    original = model._sample_action
    monkeypatch.setattr(model, "_sample_action", lambda *args: seen.append(model._n_updates) or original(*args))
    model.learn(21)
    assert seen == [0] * 9 + [1] * 3 + [2] * 3 + [3] * 3 + [4] * 3


def test_a_callback_that_stops(tiny_model, monkeypatch):
    events = []
    model, mine = events_of(tiny_model, monkeypatch, 100, DiaryCallback(events, last=15))
    assert model.num_timesteps == 15 and events == "start step step end start step".split()
    assert mine.count("update") == 1 and model.replay_buffer.size() == 2 * 7 + 4  # its step's row is kept, too


def test_schedules_see_the_steps_as_in_sb3(tiny_model, monkeypatch):
    model = tiny_model(CounterEnv(6), learning_rate=lambda remaining: 1e-2 * remaining, train_freq=3, learning_starts=6)
    rates = []
    original = model.train
    monkeypatch.setattr(
        model, "train", lambda *args: original(*args) or rates.append(model.learner.model_optimizer.learning_rate)
    )
    model.learn(30)
    assert rates == pytest.approx([1e-2 * (1 - step / 30) for step in range(9, 31, 3)])


@pytest.mark.parametrize("overlap", [1, "auto", None])
def test_arguments(tiny_model, overlap):
    with pytest.raises(ValueError, match=f"overlap must be True or False, got {overlap!r}"):
        tiny_model(overlap=overlap)


# -- when something goes wrong ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
@pytest.mark.parametrize("overlap", [True, False])
def test_an_update_that_raises_leaves_the_environments_usable(tiny_model, monkeypatch, subproc, error, overlap):
    model = tiny_model(subproc[2], overlap=overlap).learn(60)
    with monkeypatch.context() as patch:
        patch.setattr(model.learner, "update", lambda _: (_ for _ in ()).throw(error("no")))
        with pytest.raises(error, match="no"):
            model.learn(60, reset_num_timesteps=False)
    goes_on(model)


def goes_on(model):
    """Check that a model whose step was lost goes on with whole episodes."""
    assert model.phase_timesteps == model.num_timesteps
    before = model.replay_buffer.finished_count
    model.learn(60, reset_num_timesteps=False)
    assert model.replay_buffer.finished_count > before + 2
    whole_episodes(model)


def whole_episodes(model):
    """Check that each row holds the action that its image answers."""
    for episode in model.replay_buffer.episodes:
        # Whole episodes of one environment each: the sum of actions grows as the images say.
        sums = np.abs(episode.action.astype(np.float64)).sum(1).cumsum()
        images = episode.observation[:, 0, 0, 0].astype(int)
        distance = np.abs((1000 * sums).astype(int) % 256 - images)
        assert np.minimum(distance, 256 - distance).max() <= 1


class BreakingEnv(AnsweringEnv):
    """Raises once, if asked to."""

    broken = False

    def step(self, action):
        if self.broken:
            self.broken = False
            raise RuntimeError("broken")
        return super().step(action)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_environments_that_stepped_beside_one_that_was_given_up_on(tiny_model, tmp_path):
    """What they gave is lost, so that their episodes must not go on."""
    envs = [FaultGuard(BreakingEnv(), max_faults=1), FaultGuard(BreakingEnv(), max_faults=1)]
    model = tiny_model(DummyVecEnv([lambda: envs[0], lambda: envs[1]]), tensorboard_log=str(tmp_path)).learn(64)
    envs[1].env.broken = True
    with pytest.raises(EnvironmentFaultError, match="broken"):
        model.learn(60, reset_num_timesteps=False)
    goes_on(model)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize(
    ("sign", "reason"),
    [(signal.SIGKILL, "ended by signal SIGKILL"), (signal.SIGSTOP, "no answer within 2 s")],
    ids=["dies", "hangs"],
)
def test_a_process_that_dies_or_hangs_during_an_update_is_replaced(tiny_model, monkeypatch, sign, reason):
    """The time limit begins when the update is over: one that takes longer makes no fault."""
    # Short only where it has to be waited for; a busy machine takes its time.
    step_timeout = 2.0 if sign == signal.SIGSTOP else 600.0
    env = SupervisedVecEnv([functools.partial(monitored, AnsweringEnv)] * 2, step_timeout=step_timeout, start_timeout=600.0)
    try:
        model = tiny_model(env)
        update, reasons, updates = model.learner.update, [], []

        def harmful(batch):
            updates.append(model.num_timesteps)
            if len(updates) == 2 and sign == signal.SIGSTOP:
                time.sleep(2.2)
            if len(updates) == 4:
                os.kill(env.workers[1].process.pid, sign)
            return update(batch)

        def look(local, _):
            reasons.extend((local["self"].num_timesteps, info[FAULT]) for info in local["infos"] if FAULT in info)
            return True

        monkeypatch.setattr(model.learner, "update", harmful)
        model.learn(100, callback=look)
    finally:
        env.close()
    [(step, text)] = reasons
    # The answer may have been on its way already: then it is the next step that fails.
    assert reason in text and step - updates[3] in (2, 4) and model.env_faults == 1 and len(updates) > 6
    whole_episodes(model)


def test_an_environment_that_dies_during_an_update(tiny_model):
    env = processes(DyingEnv, 10)
    try:
        model = tiny_model(env, train_freq=7, learning_starts=0, max_grad_norm=100.0)
        with pytest.raises((EOFError, ConnectionError)):
            model.learn(30)
        assert model.num_timesteps == 6
        # What it is closed with does not hang.
        env.waiting = False
    finally:
        env.processes[0].join(10)
        env.closed = True
