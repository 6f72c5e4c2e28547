"""The counting environment under an id, as a task of the walker: commands make it by name."""

from __future__ import annotations

import gymnasium
from fake_envs import CounterEnv

ENV = "analysis/Counter-v0"
STEPS = 8

if ENV not in gymnasium.registry:
    gymnasium.register(ENV, CounterEnv, kwargs={"length": STEPS, "domain": "walker", "task": "run", "action_repeat": 2})
