"""The device that was asked for is the one that is used, or a warning says which one is."""

from __future__ import annotations

import warnings

import pytest
import torch as th
from fake_envs import CounterEnv

from sb3_dreamer_urlb import DreamerV2, DrQv2

ALGORITHMS = pytest.mark.parametrize("algorithm", [DreamerV2, DrQv2])


@pytest.fixture(autouse=True)
def without_cuda(monkeypatch):
    monkeypatch.setattr(th.cuda, "is_available", lambda: False)


@ALGORITHMS
@pytest.mark.parametrize("device", ["cuda", "cuda:1", th.device("cuda")])
def test_a_device_that_is_not_here(algorithm, device, tmp_path):
    message = f"device='{device}': torch .* finds no such device here, cpu is used"
    with pytest.warns(UserWarning, match=message) as told:
        model = algorithm("MlpPolicy", CounterEnv(9), preset="tiny", device=device)
    assert model.device == th.device("cpu") and len([one for one in told if "device=" in str(one.message)]) == 1
    model.save(tmp_path / "model")
    model.policy.save(tmp_path / "policy")
    for load, path in ((algorithm.load, "model"), (type(model.policy).load, "policy")):
        with pytest.warns(UserWarning, match=message) as told:
            load(tmp_path / path, device=device)
        assert len([one for one in told if "device=" in str(one.message)]) == 1


@ALGORITHMS
@pytest.mark.parametrize("device", ["auto", "cpu", th.device("cpu"), "cpu:0"])
def test_a_device_that_is_here(algorithm, device):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        algorithm("MlpPolicy", CounterEnv(9), preset="tiny", device=device)
