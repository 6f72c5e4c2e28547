"""The twelve tasks against the benchmark's own code: rewards, frames, episode lengths, action bounds.

``golden_envs.json`` tells in ``_about`` how it was made. Frames are compared by hash where the first one matches, for
then the renderer is the one the file was made with (Mesa's llvmpipe, by EGL or OSMesa); a GPU draws slightly other
pixels, and then the frame's mean colour must agree.
"""

from __future__ import annotations

import functools
import hashlib
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import TESTS

from sb3_dreamer_urlb.envs import URLB_TASKS, make_control_env, make_urlb_env

TASKS = [(domain, task) for domain, tasks in URLB_TASKS.items() for task in tasks]
MEAN_COLOUR_TOLERANCE = 0.5  # of 255


@functools.cache
def golden() -> dict[str, Any]:
    here = TESTS
    folders = [os.environ.get("SB3_DREAMER_GOLDEN"), here.parents[1] / "shared" / "golden", here / "golden"]
    path = next(path for folder in folders if folder and (path := Path(folder, "golden_envs.json")).is_file())
    return json.loads(path.read_text())


def sha256(array: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()


def play(env: Any, actions: np.ndarray, monkeypatch: pytest.MonkeyPatch) -> tuple[list[float], np.ndarray, np.ndarray]:
    """Rewards, first and last observation; the frames in between are not drawn, for they cost most of the time."""
    first, _ = env.reset(seed=0)
    with monkeypatch.context() as patch:
        patch.setattr(env, "_picture", lambda size: np.zeros((size, size, 3), np.uint8))
        rewards = [env.step(action)[1] for action in actions[:-1]]
    last, reward, *_ = env.step(actions[-1])
    return [*rewards, reward], first, last


@pytest.mark.parametrize(("domain", "task"), TASKS)
def test_rewards_and_frames_of_every_control_step(domain, task, monkeypatch):
    expected = golden()["tasks"][f"{domain}_{task}"]
    env = make_urlb_env(domain, task, action_repeat=1)
    actions = np.random.RandomState(0).uniform(-1, 1, (golden()["T"], expected["action_dim"]))
    rewards, first, last = play(env, actions, monkeypatch)
    env.close()

    np.testing.assert_allclose(rewards, expected["rewards"], rtol=1e-6, atol=0)
    same_renderer = sha256(first) == expected["frame0_sha256"]
    for frame, name in ((first, "frame0"), (last, "frame50")):
        assert np.abs(frame.mean((0, 1)) - expected[f"{name}_mean_rgb"]).max() < MEAN_COLOUR_TOLERANCE
        assert not same_renderer or sha256(frame) == expected[f"{name}_sha256"]


@pytest.mark.parametrize(("domain", "task"), TASKS)
def test_the_official_pipeline_with_an_action_repeat_of_two(domain, task, monkeypatch):
    expected = golden()["tasks"][f"{domain}_{task}"]
    env = make_urlb_env(domain, task)
    rewards = expected["official_pipeline_ar2_rewards"]
    actions = np.random.RandomState(0).uniform(-1, 1, (len(rewards), expected["action_dim"])).astype(np.float32)
    ours, first, last = play(env, actions, monkeypatch)
    env.close()

    np.testing.assert_allclose(ours, rewards, rtol=1e-6, atol=0)
    assert list(first.transpose(2, 0, 1).shape) == expected["official_pipeline_obs_shape"]
    if sha256(first) == expected["frame0_sha256"]:  # the renderer of the file
        assert sha256(first.transpose(2, 0, 1)) == expected["official_pipeline_first_obs_sha256"]
        assert sha256(last.transpose(2, 0, 1)) == expected["official_pipeline_last_obs_sha256"]


@pytest.mark.parametrize(("domain", "task"), TASKS)
def test_the_control_environment(domain, task):
    """Without pixels: an episode's length, how it ends, time steps, action bounds."""
    expected = golden()["tasks"][f"{domain}_{task}"]
    env = make_control_env(domain, task)
    spec = env.action_spec()
    np.testing.assert_allclose(spec.minimum, expected["action_min"], rtol=1e-12)
    np.testing.assert_allclose(spec.maximum, expected["action_max"], rtol=1e-12)
    assert env.physics.timestep() == pytest.approx(expected["physics_timestep"], rel=1e-12)
    assert env.control_timestep() == pytest.approx(expected["control_timestep"], rel=1e-12)

    env.reset()
    steps, action = 1, (spec.minimum + spec.maximum) / 2
    while not (time_step := env.step(action)).last():
        steps += 1
    assert steps == expected["episode"]["control_steps"]
    assert time_step.discount == expected["episode"]["discount_at_end"]


def test_the_reward_of_jaco_over_the_distance():
    """The golden rewards above are about 1e-14, for random actions do not reach the brick: move the brick to the hand."""
    table = golden()["jaco_tolerance"]
    env = make_control_env("jaco", "reach_bottom_right")
    env.reset()
    hand = env.physics.bind(env.task.hand.tool_center_point).xpos.copy()
    for distance, reward in zip(table["distance"], table["reward"], strict=True):
        env.task._prop.set_pose(env.physics, position=hand + [0, distance, 0])
        env.physics.forward()
        assert env.task.get_reward(env.physics) == pytest.approx(reward, rel=1e-6)


@pytest.mark.parametrize(
    ("task", "x", "y"),
    [
        ("reach_top_left", -0.09, 0.09),
        ("reach_top_right", 0.09, 0.09),
        ("reach_bottom_left", -0.09, -0.09),
        ("reach_bottom_right", 0.09, -0.09),
    ],
)
def test_the_brick_lies_where_the_task_says(task, x, y):
    env = make_control_env("jaco", task)
    for _ in range(2):
        env.reset()
        position, _ = env.task._prop.get_pose(env.physics)
        np.testing.assert_allclose(position[:2], [x, y], atol=1e-6)
