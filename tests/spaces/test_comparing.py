"""Where two spaces differ is said part by part."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from fake_envs import CounterEnv
from gymnasium import spaces
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_dreamer_urlb.spaces.comparing import check_same_spaces

VECTOR, IMAGE = spaces.Box(-1, 1, (3,), np.float32), spaces.Box(0, 255, (3, 16, 16), np.uint8)
BOUNDED = spaces.Box(np.array([-1, -1, -1], np.float32), np.array([1, 0.5, 1], np.float32))
DICT = spaces.Dict(image=IMAGE, state=VECTOR)
ACTIONS = spaces.Box(-1, 1, (2,), np.float32)


def difference(ours, theirs, actions=(ACTIONS, ACTIONS), domains=(None, None)):
    """What is said of an environment with ``theirs``."""
    model = SimpleNamespace(observation_space=ours, action_space=actions[0], domain=domains[0])
    env = DummyVecEnv([lambda: CounterEnv(observation_space=theirs, action_space=actions[1], domain=domains[1])])
    # Whatever Stable-Baselines3 would refuse, and nothing else.
    with pytest.raises(ValueError, match="spaces do not match"):
        check_for_correct_spaces(env, model.observation_space, model.action_space)
    with pytest.raises(ValueError) as caught:
        check_same_spaces(env, model)
    return str(caught.value)


def test_equal_spaces_pass():
    for space in (VECTOR, IMAGE, BOUNDED, DICT, spaces.Discrete(3)):
        env = DummyVecEnv([lambda space=space: CounterEnv(observation_space=space, action_space=ACTIONS)])
        check_same_spaces(env, SimpleNamespace(observation_space=space, action_space=ACTIONS, domain=None))


@pytest.mark.parametrize(
    ("ours", "theirs", "said"),
    [
        (VECTOR, spaces.Discrete(3), f"the model's is {VECTOR}, the environment's Discrete(3)."),
        (VECTOR, BOUNDED, f"the model's is {VECTOR}, the environment's {BOUNDED}."),
        (DICT, spaces.Dict(image=IMAGE), "'state' is the model's only."),
        (
            spaces.Dict(image=IMAGE, touch=VECTOR),
            spaces.Dict(image=spaces.Box(0, 255, (3, 20, 20), np.uint8), state=VECTOR),
            "the model's of 'image' is Box(0, 255, (3, 16, 16), uint8), the environment's Box(0, 255, (3, 20, 20), uint8); "
            "'state' is the environment's only; 'touch' is the model's only.",
        ),
    ],
)
def test_observations_that_differ(ours, theirs, said):
    message = difference(ours, theirs)
    assert message.startswith(f"Observation spaces do not match: {said} A model goes on where") and "Action" not in message


def test_bounds_that_look_alike_are_told_apart():
    """Of a large Box, numpy prints the first bounds and the last."""

    def bounded(*halves):
        high = np.ones(2000, np.float32)
        high[list(halves)] = 0.5
        return spaces.Box(-1, high)

    assert str(bounded(7)) == str(bounded(9))
    assert "with high[7] = 0.5, the environment's has 1.0 there." in difference(bounded(7), bounded(9))


def test_both_are_told_and_so_are_the_domains():
    others = ACTIONS, spaces.Box(-1, 1, (5,), np.float32)
    message = difference(VECTOR, IMAGE, others)
    assert "Observation spaces do not match" in message and f"Action spaces do not match: the model's is {ACTIONS}" in message
    learnt = "The model has learnt in the domain 'walker', this is 'quadruped'."
    assert learnt in difference(VECTOR, VECTOR, others, ("walker", "quadruped"))
    for domains in (("walker", "walker"), ("walker", None), (None, "walker")):
        assert "learnt in" not in difference(VECTOR, VECTOR, others, domains)
