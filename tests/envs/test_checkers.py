"""Gymnasium's and Stable-Baselines3's checkers have nothing to say about any id, however it is observed."""

from __future__ import annotations

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from sb3_dreamer_urlb.cli.tasks import tasks
from sb3_dreamer_urlb.envs import PRIMAL_TASK, env_id
from sb3_dreamer_urlb.envs.options import OBSERVATIONS

SUITE = "urlb/dm_control-v0"
#: id → arguments
IDS = {**{task.id: {} for task in tasks()}, SUITE: {"domain": "cartpole", "task": "swingup"}}
DRAWN = {(env_id(domain, task), observation) for domain, task in PRIMAL_TASK.items() for observation in ("pixels", "both")}
#: Jaco's reset compiles its model, and Gymnasium's checker resets some twenty times: the benchmark's task and a variant.
JACO = ("urlb/jaco-reach_top_left-v0", "urlb/jaco-reach_top_left-fixed-v0")
CASES = [(name, kind) for name in IDS for kind in OBSERVATIONS if "jaco" not in name or name in JACO or kind == "state"]


def test_no_id_is_left_out():
    assert set(IDS) == {name for name in gymnasium.registry if name.split("/")[0] in ("urlb", "rwrl")}


@pytest.mark.parametrize(("name", "observation"), CASES)
def test_the_checkers_have_nothing_to_say(name, observation, monkeypatch):
    """One task a domain with its pictures; the others' pictures are made of the bytes of their state, which is much cheaper
    and as deterministic as the simulation is.
    """
    drawn = (name, observation) in DRAWN
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = gymnasium.make(name, observation=observation, render_mode="rgb_array" if drawn else None, **IDS[name])
        inner = env.unwrapped
        if not drawn:
            state = lambda: inner._control.physics.data.qpos.copy().view(np.uint8)  # noqa: E731
            monkeypatch.setattr(inner, "_picture", lambda size: np.resize(state(), (size, size, 3)))
        sb3_check_env(inner)
        if "jaco" not in name or name in JACO:
            gymnasium_check_env(inner, skip_render_check=not drawn, skip_close_check=not drawn)
        env.reset(seed=3)  # with gymnasium.make's own wrappers
        env.step(env.action_space.sample())
        if drawn:
            assert env.render().shape == (256, 256, 3)
        env.close()
        env.close()
