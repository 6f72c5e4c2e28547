"""Environments seen as dm_control's own numbers: what they hold, that the physics is the pixels', that no OpenGL is needed."""

from __future__ import annotations

import functools

import gymnasium
import numpy as np
import pytest
from dm_control.rl.control import flatten_observation
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_util import make_vec_env
from without_display import run

from sb3_dreamer_urlb.envs import PRIMAL_TASK, URLB_TASKS, env_id, make_control_env, make_dmc_env, make_urlb_env, options

TASKS = [(domain, task) for domain, tasks in URLB_TASKS.items() for task in tasks]
SIZES = {"walker": 24, "quadruped": 78, "jaco": 55}


@pytest.mark.parametrize(("domain", "task"), TASKS)
def test_the_state_is_dm_controls_own_in_its_order(domain, task):
    env = make_urlb_env(domain, task, observation="state")
    state, info = env.reset(seed=3)
    control_env = make_control_env(domain, task)
    _seed(control_env, 3)
    time_step = control_env.reset()
    assert state.dtype == np.float32 and state.shape == env.observation_space.shape == (SIZES[domain],) and info == {}
    action = np.full(env.action_space.shape, 0.5, np.float32)
    for _ in range(3):
        expected = flatten_observation(time_step.observation)["observations"].astype(np.float32)
        np.testing.assert_array_equal(state, expected)
        assert [name for name, _ in env.state_parts] == list(time_step.observation)
        start = 0
        for name, size in env.state_parts:
            np.testing.assert_array_equal(state[start : start + size], np.float32(time_step.observation[name]).ravel())
            start += size
        state = env.step(action)[0]
        for _ in range(2):
            time_step = control_env.step(env._to_control(action))
    env.close()


def test_the_documented_order_of_the_walker():
    env = make_urlb_env("walker", "run", observation="state")
    assert env.state_parts == (("orientations", 14), ("height", 1), ("velocity", 9))


@settings(max_examples=12, deadline=None)
@given(task=st.sampled_from(TASKS), seed=st.integers(0, 2**32 - 1), action_repeat=st.integers(1, 3))
def test_returns_are_the_same_however_the_task_is_observed(task, seed, action_repeat):
    """A scripted controller: the same rewards, ends and simulation to the last bit."""
    kinds = []
    for observation in options.OBSERVATIONS:
        env = make_urlb_env(*task, observation=observation, action_repeat=action_repeat)
        env._picture = lambda size: np.zeros((size, size, 3), np.uint8)
        env.reset(seed=seed)
        phases = np.arange(env.action_space.shape[0])
        steps = [env.step(np.sin(0.3 * t + phases).astype(np.float32))[1:4] for t in range(6)]
        kinds.append((steps, env._control.physics.data.qpos.tobytes()))
        env.close()
    assert kinds[0] == kinds[1] == kinds[2]


@pytest.mark.parametrize("domain", URLB_TASKS)
def test_attributes_are_those_of_the_pixels(domain):
    task = PRIMAL_TASK[domain]
    pixels, *others = (gymnasium.make(env_id(domain, task), observation=kind) for kind in options.OBSERVATIONS)
    for other in others:
        for name in ("domain", "task", "action_repeat", "never_terminates", "max_episode_steps", "metadata", "action_space"):
            assert other.get_wrapper_attr(name) == pixels.get_wrapper_attr(name), name


def test_both_hold_what_each_holds():
    seen = {}
    for kind in options.OBSERVATIONS:
        env = make_urlb_env("walker", "walk", observation=kind)
        seen[kind] = [env.reset(seed=5)[0], env.step(np.ones(6, np.float32))[0]]
        env.close()
    for pixels, state, both in zip(*(seen[kind] for kind in options.OBSERVATIONS), strict=True):
        assert sorted(both) == ["image", "state"]
        np.testing.assert_array_equal(both["image"], pixels)
        np.testing.assert_array_equal(both["state"], state)


def test_any_other_task_of_dm_control():
    env = gymnasium.make("urlb/dm_control-v0", domain="cartpole", task="swingup", observation="state")
    assert env.unwrapped.state_parts == (("position", 3), ("velocity", 2))
    unlimited = make_dmc_env("lqr", "lqr_2_1", observation="state")  # no time limit, no bounds on its actions
    assert unlimited.reset(seed=0)[0].shape == (4,) and unlimited.max_episode_steps is None
    scalars = make_dmc_env("hopper", "stand", observation="state")  # parts of one number
    assert scalars.observation_space.contains(scalars.reset(seed=0)[0])
    cameras = make_dmc_env("manipulation", "reach_site_vision", observation="state")
    assert not any("camera" in name for name, _ in cameras.state_parts)


def test_seeds_and_streams():
    one, other = (make_urlb_env("jaco", "reach_top_left", observation="state") for _ in range(2))
    assert not np.array_equal(one.reset()[0], other.reset()[0])
    first = [env.reset(seed=4)[0] for env in (one, other)]
    second = [env.reset()[0] for env in (one, other)]
    np.testing.assert_array_equal(*first)
    np.testing.assert_array_equal(*second)
    assert not np.array_equal(first[0], second[0])


#: GLFW's own library, which Shimmy imports, loads OpenGL when a window is opened. It is no OpenGL library itself.
NO_OPENGL = """
import os, sys
import sb3_dreamer_urlb.envs as envs
def loaded():
    files = {line.split()[-1] for line in open("/proc/self/maps") if "/" in line}
    names = [os.path.basename(file) for file in files]
    return sorted({name for name in names if any(part in name for part in ("GL", "Mesa", "swrast", "gallium"))})
"""


def test_no_renderer_is_imported_and_no_opengl_library_loaded():
    """Not even where ``MUJOCO_GL`` names one: with ``vulkan``, dm_control would refuse to be imported."""
    code = """
import gymnasium
for domain, task in [("walker", "run"), ("quadruped", "jump"), ("jaco", "reach_top_left"), ("cartpole", "swingup")]:
    env = gymnasium.make("urlb/dm_control-v0", domain=domain, task=task, observation="state", render_mode="rgb_array")
    env.reset(seed=0)
    env.step(env.action_space.sample())
    env.close()
modules = [name for name in sys.modules if name.split(".")[0] == "OpenGL"]
print(loaded(), modules, os.environ.get("MUJOCO_GL"))
"""
    assert run(NO_OPENGL + code) == "[] [] None"
    assert run(NO_OPENGL + code, MUJOCO_GL="vulkan") == "[] [] vulkan"


def test_states_where_no_library_of_graphics_can_be_loaded():
    """As in a container without any: whoever asks the loader for one is refused."""
    code = """
import sys
def refuse(event, arguments):
    if event == "ctypes.dlopen" and any(part in str(arguments[0]) for part in ("GL", "Mesa", "libX11")):
        raise OSError(f"{arguments[0]}: cannot open shared object file")
sys.addaudithook(refuse)
import ctypes
try:
    ctypes.CDLL("libGL.so.1")
except OSError:
    print("refused")
import gymnasium, numpy
import sb3_dreamer_urlb
for name in ("urlb/walker-run-v0", "urlb/quadruped-jump-v0", "urlb/jaco-reach_top_left-v0", "rwrl/walker-walk-hard-v0"):
    env = gymnasium.make(name, observation="state")
    env.reset(seed=0)
    print(numpy.isfinite(env.step(env.action_space.sample())[0]).all())
"""
    assert run(code).split() == ["refused"] + ["True"] * 4


def test_an_agent_learns_is_kept_and_acts_where_there_is_no_opengl(tmp_path):
    """Neither a library of graphics nor the module OpenGL can be had: a run from states does not ask for either."""
    code = f"""
import sys
def refuse(event, arguments):
    if event == "ctypes.dlopen" and any(part in str(arguments[0]) for part in ("GL", "Mesa", "libX11")):
        raise OSError(f"{{arguments[0]}}: cannot open shared object file")
    if event == "import" and arguments[0].split(".")[0] == "OpenGL":
        raise ImportError("no module named OpenGL")
sys.addaudithook(refuse)
import gymnasium
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize
from sb3_dreamer_urlb import DreamerV2
for name in ("urlb/walker-run-v0", "rwrl/walker-walk-easy-v0"):
    env = VecNormalize(make_vec_env(name, seed=0, env_kwargs={{"observation": "state"}}), norm_reward=False)
    model = DreamerV2("MlpPolicy", env, preset="tiny", intrinsic_reward="lbs", train_freq=100, device="cpu", seed=0)
    model.learn(510)
    model.fine_tune()
    model.learn(510, reset_num_timesteps=False)
    model.save({str(tmp_path / "agent.zip")!r})
    again = DreamerV2.load({str(tmp_path / "agent.zip")!r}, env=env, device="cpu")
    action, _ = again.predict(env.reset(), deterministic=True)
    print(again.phase, action.shape, model._n_updates > 0)
print([name for name in sys.modules if name.split(".")[0] == "OpenGL"])
"""
    assert run(code).splitlines()[-3:] == ["finetuning (1, 6) True"] * 2 + ["[]"]


def test_pixels_after_states_in_the_same_process():
    """The renderer is found when it is wanted: of the state environment itself, of another, of the bare physics."""
    code = """
state = envs.make_urlb_env("walker", "run", observation="state", render_mode="rgb_array")
control = envs.make_control_env("walker", "walk")
control.reset(), state.reset(seed=1)
assert not loaded()
film = state.render()
pixels = envs.make_urlb_env("walker", "run")
same = (pixels.reset(seed=1)[0] == state._picture(64)).all()
print(film.shape, film.std() > 10, same, control.physics.render(48, 48).std() > 10)
state.close(), pixels.close(), control.physics.free()
"""
    assert run(NO_OPENGL + code) == "(256, 256, 3) True True True"


def test_pixels_where_there_is_no_opengl_are_one_clear_error_and_states_go_on():
    code = """
from sb3_dreamer_urlb.envs import rendering
rendering._load = lambda *names: None  # no library to be found
state = envs.make_urlb_env("walker", "run", observation="state", render_mode="rgb_array")
state.reset(seed=0)
for attempt in (state.render, lambda: envs.make_urlb_env("walker", "run"), state.render):
    try:
        attempt()
    except envs.RenderingBackendError as error:
        print("neither EGL nor OSMesa works here" in str(error), state.step(state.action_space.sample())[0].shape)
"""
    assert run(NO_OPENGL + code).split("\n") == ["True (24,)"] * 3
    switched_off = """
try:
    state = envs.make_urlb_env("walker", "run", observation="state", render_mode="rgb_array")
    state.reset(seed=0)
    state.render()
except envs.RenderingBackendError as error:
    print(error)
"""
    assert "MUJOCO_GL='disable' says so" in run(NO_OPENGL + switched_off, MUJOCO_GL="disable")


def test_stable_baselines3_makes_them():
    """It asks for a render mode whether or not anything is rendered."""
    envs = make_vec_env("urlb/walker-run-v0", n_envs=2, seed=0, env_kwargs={"observation": "state"})
    assert envs.reset().shape == (2, 24)
    envs.close()


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"observation": "states"}, r"observation='states': expected one of pixels, state, both"),
        ({"observation": None}, r"observation=None"),
        ({"observation": "state", "image_size": 84}, r"image_size=84: observation='state' holds no image"),
        ({"observation": "state", "fast_render": True}, r"fast_render=True: observation='state' without a render_mode"),
        ({"observation": "state", "render_size": 100}, r"render_size=100: observation='state' without a render_mode"),
        ({"observation": "state", "camera": "back"}, r"camera='back': observation='state' without a render_mode"),
        ({"obs": "state"}, r"unknown option obs: known are action_repeat, camera, .*observation, .*render_size"),
    ],
)
def test_wrong_options_are_named_before_mujoco_loads(wrong, message):
    for make in (
        lambda: make_dmc_env("walker", "run", **wrong),
        functools.partial(gymnasium.make, "urlb/walker-run-v0", **wrong),
    ):
        with pytest.raises(ValueError, match=message):
            make()
    code = f"""
import sys, gymnasium, sb3_dreamer_urlb
try:
    gymnasium.make("urlb/walker-run-v0", **{wrong!r})
except ValueError:
    print("mujoco" in sys.modules)
"""
    assert run(code) == "False"


def _seed(control_env, seed):
    if hasattr(control_env, "_random_state"):
        control_env._random_state = np.random.RandomState(seed)
    else:
        control_env.task._random = np.random.RandomState(seed)
