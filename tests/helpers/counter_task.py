"""The counting environment under an id, as a task of the walker: commands make it by name."""

from __future__ import annotations

import gymnasium
import numpy as np
from fake_envs import CounterEnv

ENV = "analysis/Counter-v0"
#: the same, seen as states
STATES = "analysis/CounterStates-v0"
STEPS = 8
TASK = {"length": STEPS, "domain": "walker", "task": "run", "action_repeat": 2}

if ENV not in gymnasium.registry:
    gymnasium.register(ENV, CounterEnv, kwargs=TASK)
    space = gymnasium.spaces.Box(-1, 1, (3,), np.float32)
    gymnasium.register(STATES, CounterEnv, kwargs={**TASK, "observation_space": space})
