"""The Jaco tasks' variants: where and how much they reward, and that all else is the benchmark's."""

from __future__ import annotations

import functools

import gymnasium
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_dreamer_urlb.envs import URLB_TASKS, make_control_env, make_dmc_env

VARIANTS = [(task, kind) for task in URLB_TASKS["jaco"] for kind in ("fixed", "sparse", "dense")]


@functools.cache
def control_env(task):
    env = make_control_env("jaco", task)
    env.reset()
    return env


def reward_at(task, brick_from_hand):
    """With the brick that far, (x, y, z), from the hand; the hand stays where it is."""
    env = control_env(task)
    hand = env.physics.bind(env.task.hand.tool_center_point).xpos.copy()
    env.task._prop.set_pose(env.physics, position=hand + brick_from_hand)
    env.physics.forward()
    return env.task.get_reward(env.physics)


@pytest.mark.parametrize(("task", "kind"), VARIANTS)
def test_facts_of_the_ids(task, kind):
    env = gymnasium.make(f"urlb/jaco-{task}-{kind}-v0", observation="state")
    assert env.get_wrapper_attr("domain") == "jaco" and env.get_wrapper_attr("task") == f"{task}-{kind}"
    assert env.get_wrapper_attr("never_terminates") and env.get_wrapper_attr("max_episode_steps") == 125


@pytest.mark.parametrize(("kind", "full", "tenth"), [("", 0.05, 0.1), ("-sparse", 0.025, 0.05), ("-dense", 0.1, 0.2)])
def test_the_rewarded_area(kind, full, tenth):
    task = f"reach_top_left{kind}"
    for distance, reward in ((0.0, 1), (full, 1), (tenth, 0.1)):
        assert reward_at(task, [0, distance, 0]) == pytest.approx(reward, rel=1e-6)


@settings(max_examples=20, deadline=None)
@given(distance=st.floats(0.0, 0.4))
def test_the_maximum_is_the_same_and_sparser_never_rewards_more(distance):
    sparse, plain, dense = (reward_at(f"reach_top_left{kind}", [0, 0, distance]) for kind in ("-sparse", "", "-dense"))
    assert 0 <= sparse <= plain <= dense <= 1


@pytest.mark.parametrize("task", URLB_TASKS["jaco"])
def test_a_fixed_target_cannot_move_the_reward(task):
    near, far = (reward_at(f"{task}-fixed", [0, distance, 0]) for distance in (0.0, 0.3))
    assert near == far
    env = control_env(f"{task}-fixed")
    control_env(task).reset()
    brick, _ = control_env(task).task._prop.get_pose(control_env(task).physics)
    np.testing.assert_allclose(env.task._fixed_target[:2], brick[:2], atol=1e-6)


def test_all_else_is_the_benchmarks():
    plain = make_dmc_env("jaco", "reach_top_right", observation="state")
    state = plain.reset(seed=4)[0]
    action = np.full(plain.action_space.shape, 0.3, np.float32)
    after = plain.step(action)[0]
    for kind in ("fixed", "sparse", "dense"):
        env = make_dmc_env("jaco", f"reach_top_right-{kind}", observation="state")
        np.testing.assert_array_equal(env.reset(seed=4)[0], state)
        np.testing.assert_array_equal(env.step(action)[0], after)


def test_unknown_variants_are_answered_with_the_known_ones():
    with pytest.raises(ValueError, match=r"jaco has reach_top_left, .*reach_bottom_right-dense"):
        make_dmc_env("jaco", "reach_top_left-denser")
