"""dm_control's suite as this package loads it: no OpenGL before a frame is wanted, all is drawn from a reset's seed."""

from __future__ import annotations

import copy
import importlib
import inspect
import json
import pickle

import numpy as np
import pytest
from without_display import run

from sb3_dreamer_urlb.envs import load_renderer, make_dmc_env
from sb3_dreamer_urlb.envs.task_names import DM_CONTROL_TASKS

load_renderer()  # before dm_control takes another

from dm_control import suite  # noqa: E402
from dm_control.rl.control import flatten_observation  # noqa: E402

SUITE = {domain: tasks for domain, tasks in DM_CONTROL_TASKS.items() if domain != "manipulation"}


def uses_contexts(domain):
    return ".contexts" in inspect.getsource(importlib.import_module(f"dm_control.suite.{domain}"))


#: of all domains whose module asks for an OpenGL context itself
ASKING = [(domain, task) for domain, tasks in SUITE.items() if uses_contexts(domain) for task in tasks]


def dm_controls_own(domain, task, seed, steps=6):
    """Observations and rewards of ``suite.load`` with a seed, over two resets."""
    env = suite.load(domain, task, task_kwargs={"random": seed})
    spec = env.action_spec()
    bounded = np.abs(spec.minimum) < 1e10
    low, high = np.where(bounded, spec.minimum, -1), np.where(bounded, spec.maximum, 1)
    seen = []
    for _ in range(2):
        time_step = env.reset()
        seen.append(flatten_observation(time_step.observation)["observations"])
        for t in range(steps):
            action = 0.5 * np.sin(np.arange(spec.shape[0]) + t)
            time_step = env.step(low + (action + 1) / 2 * (high - low))
            seen.append([*flatten_observation(time_step.observation)["observations"], time_step.reward])
    env.physics.free()
    return [np.float32(row).tolist() for row in seen]


def ours(domain, task, seed, steps=6):
    """The same of this package's environment; its source goes into another process, too."""
    env = make_dmc_env(domain, task, observation="state", action_repeat=1)
    seen = []
    for first in (True, False):
        seen.append(env.reset(seed=seed if first else None)[0])
        for t in range(steps):
            state, reward = env.step(0.5 * np.sin(np.arange(env.action_space.shape[0]) + t))[:2]
            seen.append([*state, reward])
    env.close()
    return [np.float32(row).tolist() for row in seen]


def test_there_are_tasks_that_ask_for_a_context():
    assert ("quadruped", "escape") in ASKING


@pytest.mark.parametrize("gl", ["disable", None])
def test_what_asks_for_a_context_at_a_reset_needs_none_from_states(gl):
    """The same numbers as dm_control's own, which makes the context."""
    code = f"""
import json, os, sys
import numpy as np
from sb3_dreamer_urlb.envs import make_dmc_env
{inspect.getsource(ours)}
print(json.dumps([ours(*task, 3) for task in {ASKING!r}]))
files = {{os.path.basename(line.split()[-1]) for line in open("/proc/self/maps") if "/" in line}}
print([name for name in files if any(part in name for part in ("GL", "Mesa", "swrast", "gallium"))])
print([name for name in sys.modules if name.split(".")[0] == "OpenGL"])
"""
    *_, seen, libraries, modules = run(code, **({} if gl is None else {"MUJOCO_GL": gl})).splitlines()
    assert (libraries, modules) == ("[]", "[]")
    for (domain, task), mine in zip(ASKING, json.loads(seen), strict=True):
        assert mine == dm_controls_own(domain, task, 3), (domain, task)


def test_the_ground_that_is_drawn_is_each_episodes():
    own = suite.load("quadruped", "escape", task_kwargs={"random": 3})
    env = make_dmc_env("quadruped", "escape")
    frames = []
    for seed in (3, None):
        own.reset()
        frames.append(env.reset(seed=seed)[0])
        np.testing.assert_array_equal(frames[-1], own.physics.render(64, 64, camera_id=2))
    assert not np.array_equal(*frames)
    own.physics.free()
    env.close()


@pytest.mark.parametrize(("domain", "task"), [*((domain, tasks[0]) for domain, tasks in SUITE.items()), ("lqr", "lqr_6_2")])
def test_a_seeded_reset_is_dm_controls_own_seed(domain, task):
    """Also of what a task draws when it is loaded."""
    one = ours(domain, task, 7, steps=3)
    assert one == ours(domain, task, 7, steps=3) == dm_controls_own(domain, task, 7, steps=3)


def test_another_seed_is_another_model_and_no_seed_the_same():
    env = make_dmc_env("lqr", "lqr_2_1", observation="state")

    def stiffness(seed):
        env.reset(seed=seed)
        return env._control.physics.model.jnt_stiffness.tolist()

    first = stiffness(1)
    assert stiffness(None) == first != stiffness(2) != stiffness(1) == first


@pytest.mark.parametrize(("domain", "task"), [("lqr", "lqr_2_1"), ("quadruped", "escape")])
def test_copies_go_on_alike(domain, task):
    env = make_dmc_env(domain, task, observation="state")
    env.reset(seed=1)
    for other in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        for seed in (2, None):
            np.testing.assert_array_equal(env.reset(seed=seed)[0], other.reset(seed=seed)[0])
