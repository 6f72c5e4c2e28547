"""What the environments promise to whoever steps them: spaces, seeds, ends of episodes, options, errors."""

from __future__ import annotations

import copy
import functools
import pickle
import re
import warnings

import gymnasium
import numpy as np
import pytest
from dm_env import StepType
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_checker import check_env as sb3_check_env
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_dreamer_urlb.envs import (
    DOMAINS,
    PRIMAL_TASK,
    URLB_TASKS,
    PixelOptions,
    env_id,
    make_control_env,
    make_dmc_env,
    make_urlb_env,
    register_envs,
)

register_envs()

TASKS = [(domain, task) for domain, tasks in URLB_TASKS.items() for task in tasks]


@pytest.fixture
def blind(monkeypatch):
    """A function that keeps an environment from drawing, which is nearly all of the cost of a step."""

    def close_eyes(env):
        monkeypatch.setattr(env.unwrapped, "_picture", lambda size: np.zeros((size, size, 3), np.uint8))
        return env

    return close_eyes


def test_the_names():
    assert DOMAINS == ("walker", "quadruped", "jaco") and len(TASKS) == 12
    assert all(PRIMAL_TASK[domain] in URLB_TASKS[domain] for domain in DOMAINS)
    registered = {name for name in gymnasium.registry if name.startswith("urlb/")}
    variants = {f"urlb/jaco-{task}-{kind}-v0" for task in URLB_TASKS["jaco"] for kind in ("fixed", "sparse", "dense")}
    assert registered == {env_id(domain, task) for domain, task in TASKS} | {"urlb/dm_control-v0"} | variants
    assert all(isinstance(gymnasium.spec(name).entry_point, str) for name in registered)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        register_envs()  # again: nothing overridden


def test_spaces_and_attributes():
    env = gymnasium.make("urlb/quadruped-walk-v0")
    assert env.observation_space == gymnasium.spaces.Box(0, 255, (64, 64, 3), np.uint8)
    assert env.action_space == gymnasium.spaces.Box(-1, 1, (12,), np.float32)
    vec_env = DummyVecEnv([lambda: env])
    for name, value in {
        "domain": "quadruped",
        "task": "walk",
        "action_repeat": 2,
        "never_terminates": True,
        "max_episode_steps": 500,
    }.items():
        assert env.get_wrapper_attr(name) == value
        assert vec_env.get_attr(name) == [value]
    with pytest.raises(AttributeError, match="no_such_name"):
        env.get_wrapper_attr("no_such_name")

    observation, info = env.reset(seed=0)
    assert observation.dtype == np.uint8 and observation.flags.c_contiguous and info == {}
    observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
    assert observation.flags.c_contiguous and observation.flags.owndata
    assert (type(reward), type(terminated), type(truncated)) == (float, bool, bool)
    assert info == {"task_reward": reward}
    env.close()


def test_frame_rates_are_true_and_shared_with_nobody():
    from shimmy.dm_control_compatibility import DmControlCompatibilityV0

    before = dict(DmControlCompatibilityV0.metadata)
    walker, quadruped = make_urlb_env("walker", "walk"), make_urlb_env("quadruped", "walk", action_repeat=1)
    assert walker.metadata["render_fps"] == pytest.approx(1 / (0.025 * 2))
    assert quadruped.metadata["render_fps"] == pytest.approx(1 / 0.02)
    assert "render_fps" not in type(walker).metadata
    assert before == DmControlCompatibilityV0.metadata


@pytest.mark.parametrize(
    ("domain", "action_repeat", "length"),
    [("walker", 2, 500), ("walker", 3, 334), ("walker", 7, 143), ("quadruped", 2, 500), ("jaco", 2, 125), ("jaco", 3, 84)],
)
def test_episodes_are_truncated_at_the_time_limit(domain, action_repeat, length, blind):
    env = blind(make_urlb_env(domain, PRIMAL_TASK[domain], action_repeat=action_repeat))
    assert env.max_episode_steps == length
    env.reset(seed=0)
    action = np.zeros(env.action_space.shape, np.float32)
    for _ in range(length - 1):
        assert env.step(action)[2:4] == (False, False)
    assert env.step(action)[2:4] == (False, True)
    with pytest.raises(ResetNeeded):
        env.step(action)
    env.reset()
    env.step(action)
    env.close()


@pytest.mark.parametrize("domain", DOMAINS)
def test_seeds(domain):
    def episode(env, seed):
        first, _ = env.reset(seed=seed)
        return [first, *(env.step(action)[0] for action in actions)]

    one, other = (make_urlb_env(domain, PRIMAL_TASK[domain], fast_render=True) for _ in range(2))
    actions = np.random.default_rng(0).uniform(-1, 1, (2, *one.action_space.shape)).astype(np.float32)
    unseeded = episode(one, None)
    assert not np.array_equal(unseeded, episode(other, None))
    seeded = episode(one, 5)
    continued = episode(one, None)
    assert not np.array_equal(seeded, continued)
    np.testing.assert_array_equal(seeded, episode(other, 5))
    np.testing.assert_array_equal(continued, episode(other, None))
    assert not np.array_equal(seeded, episode(other, 6))
    one.close(), other.close()


@pytest.fixture(scope="module")
def walker():
    env = make_urlb_env("walker", "run", render_mode="rgb_array", render_size=100)
    yield env
    env.close()


@settings(max_examples=10, deadline=None)
@given(action_repeat=st.integers(1, 5), seed=st.integers(0, 2**32 - 1))
def test_an_action_repeat_sums_the_rewards_of_the_control_steps(action_repeat, seed):
    env = make_urlb_env("quadruped", "run", action_repeat=action_repeat)
    control_env = make_control_env("quadruped", "run")
    control_env.task._random = np.random.RandomState(seed)
    spec = control_env.action_spec()
    env._picture = lambda size: np.zeros((size, size, 3), np.uint8)
    env.reset(seed=seed)
    control_env.reset()
    for action in np.random.default_rng(seed).uniform(-1, 1, (3, 12)):
        control = spec.minimum + (action + 1) / 2 * (spec.maximum - spec.minimum)
        expected = sum(control_env.step(control).reward for _ in range(action_repeat))
        assert env.step(action)[1] == pytest.approx(expected, rel=1e-9, abs=1e-12)


@settings(max_examples=50, deadline=None)
@given(action=st.lists(st.floats(-1, 1, width=32), min_size=12, max_size=12))
def test_actions_are_rescaled_to_the_bounds_of_the_task(action):
    env = _quadruped()
    spec = env._control.action_spec()
    for dtype, tolerance in ((np.float32, 1e-6), (np.float64, 1e-15)):
        control = env._to_control(np.array(action, dtype))
        assert control.dtype == np.float64
        expected = spec.minimum + (np.array(action) + 1) / 2 * (spec.maximum - spec.minimum)
        np.testing.assert_allclose(control, expected, atol=tolerance)
    np.testing.assert_array_equal(env._to_control(-np.ones(12)), spec.minimum)
    np.testing.assert_array_equal(env._to_control(np.ones(12)), spec.maximum)


@functools.cache
def _quadruped():
    return make_urlb_env("quadruped", "stand")


def test_the_last_action_of_an_episode_may_be_held_for_less(blind):
    env = blind(make_urlb_env("walker", "stand", action_repeat=3))
    env.reset(seed=0)
    action = np.zeros(6, np.float32)
    rewards = [env.step(action)[1] for _ in range(334)]  # 1000 = 333 * 3 + 1
    assert rewards[-1] == pytest.approx(rewards[-2] / 3, rel=0.05)


def test_reward_free(walker):
    free = make_urlb_env("walker", "run", reward_free=True)
    free.reset(seed=1), walker.reset(seed=1)
    for action in np.random.default_rng(1).uniform(-1, 1, (3, 6)).astype(np.float32):
        _, reward, _, _, info = walker.step(action)
        _, nothing, _, _, free_info = free.step(action)
        assert nothing == 0.0 and type(nothing) is float
        assert free_info["task_reward"] == info["task_reward"] == reward > 0
    free.close()


def test_the_picture_for_people_does_not_touch_the_observations(walker):
    before, _ = walker.reset(seed=2)
    picture = walker.render()
    assert picture.shape == (100, 100, 3) and picture.dtype == np.uint8 and picture.flags.c_contiguous
    np.testing.assert_array_equal(before, walker.reset(seed=2)[0])

    large = make_urlb_env("walker", "run", image_size=40, render_mode="rgb_array", render_size=512)  # MuJoCo's buffer: 480
    observation, _ = large.reset(seed=2)
    assert observation.shape == large.observation_space.shape == (40, 40, 3)
    assert large.render().shape == (512, 512, 3)
    large.close()


def test_large_observations_of_a_model_that_is_compiled_each_episode():
    env = make_urlb_env("jaco", "reach_top_left", image_size=512, fast_render=True)
    for _ in range(2):
        assert env.reset()[0].shape == (512, 512, 3)
    env.close()


def test_without_a_render_mode_render_warns():
    env = make_urlb_env("walker", "walk")
    env.reset()
    with pytest.warns(UserWarning, match="without a render mode"):
        assert env.render() is None
    env.close()


def test_a_window_is_gymnasiums():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make("urlb/walker-walk-v0", render_mode="human")
    assert env.render_mode == "human" and env.get_wrapper_attr("action_repeat") == 2
    env.close()


@pytest.mark.parametrize("domain", DOMAINS)
def test_fast_render_is_nearly_the_same_and_not_the_same(domain):
    frames = []
    for fast_render in (False, True):
        env = make_urlb_env(domain, PRIMAL_TASK[domain], fast_render=fast_render)
        env.reset(seed=0)
        frames.append(env.reset()[0].astype(int))  # the second episode: Jaco's model was compiled anew
        env.close()
    difference = np.abs(frames[0] - frames[1])
    assert 0 < difference.mean() < 0.5  # of 255
    assert (difference.max(-1) > 0).mean() < 0.02


@pytest.mark.parametrize(("domain", "name", "number"), [("walker", "back", 1), ("quadruped", "egocentric", 3)])
def test_cameras_by_id_and_by_name(domain, name, number):
    frames = []
    for camera in (name, number, None):
        env = make_urlb_env(domain, "walk", camera=camera, fast_render=True)
        frames.append(env.reset(seed=0)[0])
        env.close()
    np.testing.assert_array_equal(frames[0], frames[1])
    assert not np.array_equal(frames[0], frames[2])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"image_size": 15}, r"image_size=15: expected an int from 16 to 512"),
        ({"image_size": 64.0}, r"image_size=64.0"),
        ({"image_size": True}, r"image_size=True"),
        ({"render_size": 513}, r"render_size=513"),
        ({"action_repeat": 0}, r"action_repeat=0: expected an int of at least 1"),
        ({"action_repeat": 1.5}, r"action_repeat=1.5"),
        ({"camera": 1.0}, r"camera=1.0: expected a camera's id \(int\) or name \(str\)"),
        ({"reward_free": "no"}, r"reward_free='no': expected True or False"),
        ({"fast_render": 1}, r"fast_render=1"),
        ({"render_mode": "ansi"}, r"render_mode='ansi': expected None or one of rgb_array, human"),
    ],
)
def test_wrong_options_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        PixelOptions(**options)
    with pytest.raises(ValueError, match=message):
        gymnasium.make("urlb/walker-run-v0", **options)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: make_urlb_env("hopper", "hop"), "domain='hopper': expected one of walker, quadruped, jaco"),
        (lambda: make_urlb_env("walker", "jump"), "task='jump': walker has stand, walk, run, flip"),
        (lambda: env_id("walker", "jump"), "task='jump'"),
        (lambda: make_dmc_env("mars", "walk"), "domain='mars': expected one of acrobot, .*jaco, .*manipulation, .*walker"),
        (lambda: make_dmc_env("cartpole", "fly"), "task='fly': cartpole has balance, .*swingup"),
        (lambda: make_dmc_env("manipulation", "fly"), "task='fly': manipulation has .*reach_site_vision"),
        (lambda: make_urlb_env("walker", "run", camera=2), "camera=2: walker-run has the ids 0 to 1, by name side, back"),
        (lambda: make_urlb_env("walker", "run", camera="top"), "camera='top': walker-run has"),
        (lambda: make_urlb_env("walker", "run", camera=-2), "camera=-2"),
    ],
)
def test_unknown_names_are_answered_with_the_known_ones(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize(
    ("action", "message"),
    [
        (np.zeros(5, np.float32), r"shape \(5,\), expected \(6,\)"),
        (np.zeros((1, 6), np.float32), r"shape \(1, 6\)"),
        (np.array([0, 0, np.nan, 0, 0, 0], np.float32), "nan.*not finite"),
        ([0, 0, 0, 0, 0, np.inf], "inf.*not finite"),
    ],
)
def test_wrong_actions_are_named(action, message, walker):
    walker.reset(seed=0)
    with pytest.raises(ValueError, match=f"walker-run.*{message}"):
        walker.step(action)


def test_the_order_of_calls():
    env = make_urlb_env("walker", "walk", render_mode="rgb_array")
    with pytest.raises(ResetNeeded):
        env.step(np.zeros(6, np.float32))
    with pytest.raises(ResetNeeded):
        env.render()
    env.reset()
    env.close()
    env.close()
    with pytest.raises(ClosedEnvironmentError, match="walker-walk"):
        env.reset()
    for call in (lambda: env.step(np.zeros(6, np.float32)), env.render):
        with pytest.raises(ClosedEnvironmentError, match=r"walker-walk.* was closed"):
            call()


@pytest.mark.parametrize("name", ["urlb/walker-run-v0", "rwrl/walker-walk-easy-v0", "urlb/jaco-reach_top_left-v0"])
def test_seeds_that_are_none_are_named(name):
    env = gymnasium.make(name, observation="state")
    for seed in (-1, 2**32, 2**70, 1.5, True, "a", [1]):
        with pytest.raises(
            ValueError, match=rf"{re.escape(name)}.*seed={re.escape(repr(seed))}: expected None or an int from 0"
        ):
            env.reset(seed=seed)
    np.testing.assert_array_equal(env.reset(seed=np.int64(3))[0], env.reset(seed=3)[0])
    env.reset(seed=2**32 - 1)


def test_what_composer_compiles_cannot_be_copied_and_says_so():
    """Of the suite, copies go on where the original is."""
    arm = gymnasium.make("urlb/jaco-reach_top_left-v0", observation="state")
    for again in (copy.deepcopy, pickle.dumps):
        with pytest.raises(TypeError, match=r"jaco-reach_top_left.* can be neither pickled nor copied"):
            again(arm)
    walker = gymnasium.make("urlb/walker-run-v0", observation="state")
    walker.reset(seed=0)
    other = pickle.loads(pickle.dumps(walker))
    action = np.full(6, 0.3, np.float32)
    assert walker.step(action)[1] == other.step(action)[1]


@pytest.mark.parametrize("domain", DOMAINS)
def test_diverged_physics_says_whose_and_can_be_reset(domain, blind):
    from dm_control.rl.control import PhysicsError

    env = blind(gymnasium.make(env_id(domain, PRIMAL_TASK[domain])))
    env.reset(seed=0)
    env.unwrapped._control.physics.data.qpos[0] = np.nan
    action = np.zeros(env.action_space.shape, np.float32)
    with pytest.raises(PhysicsError, match=env_id(domain, PRIMAL_TASK[domain])):
        env.step(action)
    with pytest.raises(ResetNeeded):
        env.step(action)
    env.reset(seed=0)
    env.step(action)
    env.close()


def test_any_other_task_of_dm_control():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make("urlb/dm_control-v0", domain="cartpole", task="swingup", image_size=48, render_mode="rgb_array")
        gymnasium_check_env(env.unwrapped)
        sb3_check_env(env.unwrapped)
    assert env.get_wrapper_attr("never_terminates") is False
    assert env.get_wrapper_attr("max_episode_steps") == 500
    direct = make_dmc_env("cartpole", "swingup", image_size=48)
    np.testing.assert_array_equal(env.reset(seed=4)[0], direct.reset(seed=4)[0])
    env.close(), direct.close()

    urlb = make_dmc_env("walker", "flip")
    assert urlb.never_terminates is True
    unlimited = make_dmc_env("lqr", "lqr_2_1")  # no time limit, no bounds on its actions
    assert unlimited.max_episode_steps is None
    np.testing.assert_array_equal(unlimited._to_control(np.float32([0.5])), [0.5])


def test_a_task_that_terminates(blind):
    env = blind(make_dmc_env("cartpole", "swingup", action_repeat=4))
    env.reset(seed=0)
    control_step, steps = env._control.step, []

    def ends_at_the_second(action):
        steps.append(action)
        time_step = control_step(action)
        return time_step._replace(step_type=StepType.LAST, discount=0.0) if len(steps) == 2 else time_step

    env._control.step = ends_at_the_second
    assert env.step(np.zeros(1, np.float32))[2:4] == (True, False)
    assert len(steps) == 2


def test_manipulation_tasks():
    env = make_dmc_env("manipulation", "reach_site_vision", fast_render=True)
    frames = [env.reset(seed=1)[0] for _ in range(2)]
    np.testing.assert_array_equal(*frames)
    assert env.max_episode_steps == 125
    env.close()


@pytest.mark.parametrize("start_method", ["forkserver", "spawn"])
def test_in_subprocesses(start_method):
    make = functools.partial(make_urlb_env, "walker", "stand", image_size=32, fast_render=True)
    envs = SubprocVecEnv([make, make], start_method=start_method)
    try:
        envs.seed(7)
        observations = envs.reset()
        assert observations.shape == (2, 32, 32, 3) and not np.array_equal(*observations)
        _, rewards, _, infos = envs.step(np.zeros((2, 6), np.float32))
        np.testing.assert_allclose([info["task_reward"] for info in infos], rewards, rtol=1e-6)
        assert envs.get_attr("max_episode_steps") == [500, 500]
    finally:
        envs.close()
    here = make()
    np.testing.assert_array_equal(here.reset(seed=7)[0], observations[0])
    here.close()
