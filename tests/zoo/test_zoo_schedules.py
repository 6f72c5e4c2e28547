"""rl_zoo3's ``lin_1e-3`` for every learning rate: while training, in the saved model, in a run that goes on."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml
from stable_baselines3.common.utils import LinearSchedule

from sb3_dreamer_urlb.signatures import named_parameters
from sb3_dreamer_urlb.zoo import schedules
from sb3_dreamer_urlb.zoo.algorithms import ALGORITHMS

RATES = {
    name: [rate for rate in named_parameters(algorithm.kind) if rate.endswith("learning_rate")]
    for name, algorithm in ALGORITHMS.items()
}
ENV = "CartPole-v1"
#: a box of actions, which DrQ-v2 wants
ENVS = {"dreamerv2": ENV, "drq_v2": "Pendulum-v1"}


def run(zoo, algorithm, *more):
    options = ["--algo", algorithm, "--env", ENVS[algorithm], "--seed", "1", "--device", "cpu", "--verbose", "0"]
    zoo("train", *options, "--eval-freq", "-1", *more)
    [folder] = Path("logs", algorithm).iterdir()
    return ALGORITHMS[algorithm].kind.load(folder / ENVS[algorithm], device="cpu"), folder


@pytest.mark.parametrize("algorithm", ALGORITHMS)
def test_every_rate_falls_in_a_line(zoo, algorithm):
    rates = dict.fromkeys(RATES[algorithm], "lin_0.002")
    entry = {"policy": "MlpPolicy", "preset": "tiny", **rates}
    Path("own.yml").write_text(yaml.dump({ENVS[algorithm]: entry}))
    model, folder = run(zoo, algorithm, "-conf", "own.yml", "-n", "60")
    assert set(rates) >= {"learning_rate"}
    for name in rates:
        line = getattr(model, name)
        assert isinstance(line, LinearSchedule) and (line(1.0), line(0.25), line(0.0)) == (0.002, 0.0005, 0.0)
    assert set(model._learning_rates(0.5).values()) == {0.001}
    # The run goes on from its checkpoint with the same line.
    again, _ = run(zoo, algorithm, "-i", str(folder), "-n", "80")
    assert again.num_timesteps > model.num_timesteps and getattr(again, name)(0.5) == 0.001


def test_numbers_stay_numbers():
    assert schedules.of_rates({"learning_rate": 0.1, "critic_learning_rate": 1}, RATES["dreamerv2"]) == {}


@pytest.mark.parametrize("value", ["fast", "lin_", "lin_fast", "linear_0.1", "0.1"])
@pytest.mark.parametrize("name", RATES["dreamerv2"])
def test_words_that_mean_nothing(name, value):
    with pytest.raises(ValueError, match=f"^{name} must be a number or 'lin_' and a number, got '{value}'"):
        schedules.of_rates({name: value}, RATES["dreamerv2"])
