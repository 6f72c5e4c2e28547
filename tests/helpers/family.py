"""Algorithms of Stable-Baselines3 and ours, made alike."""

from __future__ import annotations

import gymnasium
import numpy as np
import torch as th
from gymnasium import spaces

from sb3_dreamer_urlb import DreamerV2

VECTOR = spaces.Box(-1, 1, (3,), np.float32)


def family_model(env, policy="MlpPolicy", algorithm=DreamerV2, **kwargs):
    """The arguments that the family's tests pass, at our smallest size."""
    common = {
        "preset": "tiny",
        "policy_kwargs": {"net_arch": [16]},
        "learning_starts": 8,
        "buffer_size": 500,
        "batch_size": 2,
        "seed": 0,
        "device": "cpu",
    }
    return algorithm(policy, env, **{**common, **kwargs})


def short(env_id="Pendulum-v1", steps=8):
    """A well-known environment with short episodes, so that replay has finished ones."""
    return lambda: gymnasium.wrappers.TimeLimit(gymnasium.make(env_id).unwrapped, steps)


def weights(model):
    return {name: value.clone() for name, value in model.policy.state_dict().items()}


def same(first, second):
    return first.keys() == second.keys() and all(th.equal(first[name], second[name]) for name in first)
