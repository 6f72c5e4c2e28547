"""The perturbations against the Real-World RL suite's own code: ``golden_rwrl.json``, or any file of its form.

``SB3_DREAMER_GOLDEN_RWRL`` names another file. A file tells in ``_about`` how it was made, seeds included. The suite asks
NumPy's global stream for everything random; ours has a stream of its own, which is given the same seed here. The suite also
draws for noise that we do not have, or that is never used: those draws are made, and thrown away, here.
"""

from __future__ import annotations

import functools
import json
import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from places import TESTS

from sb3_dreamer_urlb.envs import Perturbations, dmc, perturbations
from sb3_dreamer_urlb.envs.perturbed_control import PerturbedControl

PATH = Path(os.environ.get("SB3_DREAMER_GOLDEN_RWRL", TESTS / "golden" / "golden_rwrl.json"))
GOLDEN = json.loads(PATH.read_text())
#: probability of dropped and of stuck observations, number of dummy ones
OBSERVATION_NOISE = {"easy": (0.01, 10), "medium": (0.05, 20), "hard": (0.1, 50)}


@functools.cache
def seeds() -> tuple[int, int, int]:
    """Of NumPy's global stream, of the task, and of the first episode's actions, from the file's own words."""
    about = GOLDEN["_about"]
    [stream] = re.findall(r"np\.random\.seed\((\d+)\)", about)
    [task] = re.findall(r"\brandom=(\d+)", about)
    [actions] = re.findall(r"actions RandomState\((?:(\d+)\s*\+\s*)?ep(?:\s*\+\s*(\d+))?\)", about)
    return int(stream), int(task), int(actions[0] or actions[1] or 0)


def ours(domain: str, kwargs: dict[str, Any]) -> Perturbations:
    """The same perturbations in our words."""
    if "combined_challenge" in kwargs:
        return perturbations.level(domain, kwargs["combined_challenge"])
    found: dict[str, Any] = {}
    for name, spec in kwargs.items():
        if name == "delay_spec":
            found |= {"action_delay": spec.get("actions", 0), "reward_delay": spec.get("rewards", 0)}
        elif name == "perturb_spec":
            ranges = {"constant": spec.get("start"), "uniform": (spec["min"], spec["max"])}
            found |= {spec["param"]: ranges[spec["scheduler"]]}
        else:
            assert name == "noise_spec"
            if "repetition" in spec:
                found |= {"action_repetition": spec["repetition"]["actions_steps"]}
                found |= {"repetition_probability": spec["repetition"]["actions_prob"]}
            if "gaussian" in spec:
                found |= {"action_noise": spec["gaussian"]["actions"]}
    return Perturbations(**found)


class SuiteStream(np.random.RandomState):
    """After the noise on an action, the suite draws which of its numbers are dropped and which get stuck: none.

    :param seed: of the stream
    :param action_size: 0 where nothing is asked
    """

    def __init__(self, seed: int, action_size: int):
        super().__init__(seed)
        self.action_size = action_size

    def normal(self, *args: Any) -> Any:
        drawn = super().normal(*args)
        if len(args) == 2:  # mean and deviation: an action's
            self.binomial(n=1, p=0.0, size=2 * self.action_size)
        return drawn


def suite_observes(stream: np.random.RandomState, time_step: Any, kwargs: dict[str, Any]) -> None:
    """The draws that the suite makes for an observation."""
    parts = [np.atleast_1d(part) for part in time_step.observation.values()]
    level = kwargs.get("combined_challenge")
    if level or "gaussian" in kwargs.get("noise_spec", {}):
        for part in parts:
            stream.normal(part)
    if level:
        probability, dummies = OBSERVATION_NOISE[level]
        for _ in ("dropped", "stuck"):
            for part in parts:
                stream.binomial(n=1, p=probability, size=part.shape)
        for _ in range(dummies):
            stream.normal()


@pytest.mark.parametrize("name", GOLDEN["cases"])
def test_rewards_of_every_control_step(name):
    expected = GOLDEN["cases"][name]
    kwargs, domain = expected["kwargs"], name.split("_")[0]
    stream_seed, task_seed, action_seed = seeds()
    control_env = dmc._make_rwrl_control(domain)
    control_env.task._random = np.random.RandomState(task_seed)
    perturbed = PerturbedControl(control_env, ours(domain, kwargs), domain, "walk")
    spec = control_env.action_spec()
    perturbed.stream = SuiteStream(stream_seed, spec.shape[0] if "combined_challenge" in kwargs else 0)

    episodes = sorted(key for key in expected if key.startswith("rewards_ep"))
    assert episodes
    for number, episode in enumerate(episodes):
        suite_observes(perturbed.stream, perturbed.reset(), kwargs)
        draws = np.random.RandomState(action_seed + number)
        rewards = []
        for _ in expected[episode]:
            action = spec.minimum + (draws.uniform(-1, 1, spec.shape) + 1) / 2 * (spec.maximum - spec.minimum)
            time_step = perturbed.step(action)
            suite_observes(perturbed.stream, time_step, kwargs)
            rewards.append(time_step.reward)
        np.testing.assert_allclose(rewards, expected[episode], rtol=1e-6, atol=0)
    assert control_env.physics.model.body_mass.sum() == pytest.approx(expected["total_mass"], rel=1e-9)
    if expected["perturb_cur"] is not None:
        assert perturbed.length == pytest.approx(expected["perturb_cur"], rel=1e-9)
    control_env.physics.free()


def test_the_file_says_how_it_was_made():
    assert len(seeds()) == 3 and len(GOLDEN["cases"]) >= 1
