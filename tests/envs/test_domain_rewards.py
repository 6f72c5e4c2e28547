"""What each task of a domain would pay for the same state."""

from __future__ import annotations

import numpy as np
import pytest

from sb3_dreamer_urlb.envs.dmc import make_control_env, make_dmc_env, make_urlb_env
from sb3_dreamer_urlb.envs.registration import URLB_TASKS


@pytest.mark.parametrize(
    ("domain", "task"), [("walker", "run"), ("walker", "flip"), ("quadruped", "jump"), ("quadruped", "run")]
)
def test_rewards_are_dm_control_s_own_on_the_same_state(domain, task):
    env = make_urlb_env(domain, task, observation="state", action_repeat=1, domain_rewards=True)
    own = {name: make_control_env(domain, name) for name in URLB_TASKS[domain]}
    env.reset(seed=3)
    for action in np.random.default_rng(3).uniform(-1, 1, (40, *env.action_space.shape)).astype(np.float32):
        _, reward, _, _, info = env.step(action)
        paid = info["domain_rewards"]
        assert list(paid) == list(URLB_TASKS[domain]) and paid[task] == reward == info["task_reward"]
        for name, other in own.items():
            with other.physics.reset_context():
                other.physics.set_state(env._control.physics.get_state())
            assert paid[name] == other.task.get_reward(other.physics), name
    env.close()


def test_they_are_summed_over_the_frames_of_a_step_and_change_nothing():
    plain, telling = (make_urlb_env("walker", "walk", observation="state", domain_rewards=tells) for tells in (False, True))
    plain.reset(seed=1), telling.reset(seed=1)
    for action in np.random.default_rng(1).uniform(-1, 1, (20, 6)).astype(np.float32):
        expected, reward, *_, without = plain.step(action)
        seen, same, *_, info = telling.step(action)
        np.testing.assert_array_equal(seen, expected)
        assert same == reward == info["domain_rewards"]["walk"] and without == {"task_reward": reward}
        assert info["domain_rewards"]["stand"] > info["domain_rewards"]["run"]
    plain.close(), telling.close()


def test_perturbed_physics_are_the_ones_that_count():
    longer = {"thigh_length": 0.3}  # of a model that is compiled anew
    env = make_urlb_env("walker", "walk", observation="state", domain_rewards=True, perturbations=longer)
    for seed in range(2):
        env.reset(seed=seed)
        _, reward, *_, info = env.step(np.zeros(6, np.float32))
        assert info["domain_rewards"]["walk"] == pytest.approx(reward, rel=1e-9)
    env.close()


@pytest.mark.parametrize(
    ("make", "arguments", "said"),
    [
        (make_urlb_env, ("jaco", "reach_top_left"), "expected a task of the benchmark in walker or quadruped"),
        (make_dmc_env, ("cartpole", "swingup"), "got cartpole-swingup"),
    ],
)
def test_tasks_without_a_common_world_are_refused(make, arguments, said):
    with pytest.raises(ValueError, match=said):
        make(*arguments, observation="state", domain_rewards=True)


def test_a_switch_is_a_switch():
    with pytest.raises(ValueError, match="domain_rewards='yes': expected True or False"):
        make_urlb_env("walker", "run", observation="state", domain_rewards="yes")
