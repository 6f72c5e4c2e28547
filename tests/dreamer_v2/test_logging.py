"""What a run logs: the names in docs/logging.md and no others, into CSV, JSON and TensorBoard."""

from __future__ import annotations

import csv
import json
import re

import numpy as np
import pytest
from fake_envs import CounterEnv
from gymnasium import spaces
from places import ROOT
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import KVWriter, Logger, configure
from stable_baselines3.common.monitor import Monitor
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_dreamer_urlb import PhaseSwitchCallback, VideoCallback

PAGE = (ROOT / "docs" / "logging.md").read_text()
METHODS = ("lbs", "plan2explore", "icm", "rnd", "apt", "diayn", "aps", "random")
DICT = spaces.Dict({"a": spaces.Box(-1, 1, (3,), np.float32), "image": spaces.Box(0, 255, (16, 16, 3), np.uint8)})


def documented() -> dict[str, str]:
    """Name → meaning, from the page's tables."""
    found = {}
    for names, meaning in re.findall(r"^\| (`[a-z]+/.*?) \| (.*?) \|$", PAGE, re.MULTILINE):
        for name in re.findall(r"`(.*?)`", names):
            assert name not in found, f"{name} stands there twice"
            found[name] = meaning
    return found


class Recorder(KVWriter):
    """Keeps every dump, and what each name was kept out of."""

    def __init__(self) -> None:
        self.dumps: list[dict] = []
        self.excluded: list[dict] = []

    def write(self, key_values, key_excluded, step=0) -> None:
        self.dumps.append(dict(key_values))
        self.excluded.append(dict(key_excluded))

    def close(self) -> None:
        pass

    def names(self) -> set[str]:
        return {name for dump in self.dumps for name in dump}


class SucceedingEnv(CounterEnv):
    """Says at an episode's end whether it was a success."""

    def step(self, action):
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, reward, terminated, truncated, {**info, "is_success": True} if terminated or truncated else info


def recorded(tiny_model, steps, callback=None, **kwargs) -> tuple:
    model, recorder = tiny_model(**kwargs), Recorder()
    model.set_logger(Logger(None, [recorder]))
    return model.learn(steps, callback, log_interval=1), recorder


def test_the_page_lists_what_runs_log(tiny_model, tmp_path):
    logged: set[str] = set()
    for method in (*METHODS, None):
        kwargs = {"intrinsic_kwargs": {"k": 2}} if method in ("apt", "aps") else {}
        _, recorder = recorded(tiny_model, 32, env=CounterEnv(8), intrinsic_reward=method, **kwargs)
        logged |= recorder.names()
    # Both phases, evaluations, successes, termination, Dict observations, films.
    env, test = (SucceedingEnv(8, observation_space=DICT, terminates=True) for _ in range(2))
    callbacks = [
        PhaseSwitchCallback(32),
        EvalCallback(test, eval_freq=16, n_eval_episodes=1, verbose=0, warn=False),
        VideoCallback(SucceedingEnv(8, observation_space=DICT), video_freq=16),
    ]
    model = tiny_model(env, "MultiInputPolicy", intrinsic_reward="lbs", tensorboard_log=str(tmp_path))
    model.learn(64, callbacks, log_interval=1)
    [run] = tmp_path.iterdir()
    events = EventAccumulator(str(run))
    events.Reload()
    logged |= set(events.Tags()["scalars"]) | set(events.Tags()["images"])
    assert logged == set(documented()), (logged - set(documented()), set(documented()) - logged)
    # As texts, and at each change: one for each phase.
    assert events.Tags()["tensors"] == ["time/phase/text_summary"]
    assert [event.tensor_proto.string_val[0] for event in events.Tensors("time/phase/text_summary")] == [
        b"pretraining",
        b"finetuning",
    ]


def test_names_fit_into_the_table_on_screen():
    assert len({name[:36] for name in documented()}) == len(documented())


def test_the_tasks_reward_and_the_intrinsic_one_are_apart(tiny_model):
    env = CounterEnv(8, rewards=[1.0], action_repeat=2)
    _, recorder = recorded(tiny_model, 64, PhaseSwitchCallback(64), env=env, intrinsic_reward="lbs")
    # The environment's return, in both phases.
    assert [dump["rollout/ep_rew_mean"] for dump in recorder.dumps] == [8.0] * len(recorder.dumps)
    exploring = [dump for dump in recorder.dumps if dump["time/phase"] == "pretraining" and "train/actor_loss" in dump]
    tuning = [dump for dump in recorder.dumps if dump["time/phase"] == "finetuning" and "train/actor_loss" in dump]
    assert exploring and tuning and all(dump["train/intrinsic_reward"] != 1.0 for dump in exploring)
    # What the fine-tuning's first dump averages is from its own phase alone.
    assert not any("train/intrinsic_reward" in dump for dump in tuning)


def test_frames_and_steps(tiny_model):
    env = CounterEnv(8, action_repeat=2)
    _, recorder = recorded(tiny_model, 64, PhaseSwitchCallback(64), env=env, intrinsic_reward="lbs")
    steps = [dump["time/total_timesteps"] for dump in recorder.dumps]
    assert steps == [8, 16, 24, 32, 40, 48, 56, 64]
    assert [dump["time/total_frames"] for dump in recorder.dumps] == [2 * step for step in steps]
    assert [dump["time/phase_frames"] for dump in recorder.dumps] == [16, 32, 48, 64, 16, 32, 48, 64]
    phases = [dump["time/phase"] for dump in recorder.dumps]
    assert phases == ["pretraining"] * 4 + ["finetuning"] * 4
    # To TensorBoard only where it changes.
    assert ["tensorboard" in excluded["time/phase"] for excluded in recorder.excluded] == [False, True, True, True] * 2


def test_csv_json_and_tensorboard_hold_the_same_numbers(tiny_model, tmp_path):
    model = tiny_model(make_vec_env(lambda: CounterEnv(8), 2), intrinsic_reward="lbs")
    model.set_logger(configure(str(tmp_path), ["csv", "json", "tensorboard"]))
    model.learn(64, log_interval=1)
    model.logger.close()
    rows = list(csv.DictReader((tmp_path / "progress.csv").open()))
    lines = [json.loads(line) for line in (tmp_path / "progress.json").read_text().splitlines()]
    assert len(rows) == len(lines) == 8
    for row, line in zip(rows, lines, strict=True):
        assert {name for name, value in row.items() if value} == set(line)
        assert row["time/phase"] == line["time/phase"] == "pretraining"
        numbers = set(line) - {"time/phase"}
        assert all(float(row[name]) == pytest.approx(line[name]) for name in numbers)
    events = EventAccumulator(str(tmp_path), size_guidance={"scalars": 0})
    events.Reload()
    for name in ("rollout/ep_rew_mean", "train/kl", "train/intrinsic_reward", "time/total_frames"):
        values = [(line["time/total_timesteps"], line[name]) for line in lines if name in line]
        scalars = [(event.step, event.value) for event in events.Scalars(name)]
        assert [step for step, _ in scalars] == [step for step, _ in values] and len(values) > 1
        assert np.allclose([value for _, value in scalars], [value for _, value in values])
    # A count that TensorBoard shows already, as its x-axis.
    assert "time/total_timesteps" not in events.Tags()["scalars"]


def test_evaluations_are_logged_as_sb3_does(tiny_model, tmp_path):
    test = EvalCallback(
        Monitor(CounterEnv(8, rewards=[1.0])), eval_freq=16, n_eval_episodes=2, verbose=0, log_path=str(tmp_path)
    )
    _, recorder = recorded(tiny_model, 33, test, env=CounterEnv(8))
    evaluations = [dump for dump in recorder.dumps if "eval/mean_reward" in dump]
    assert [(dump["eval/mean_reward"], dump["eval/mean_ep_length"]) for dump in evaluations] == [(8.0, 8.0)] * 2
    assert [dump["time/total_timesteps"] for dump in evaluations] == [16, 32]
    assert np.load(tmp_path / "evaluations.npz")["results"].tolist() == [[8.0, 8.0]] * 2
