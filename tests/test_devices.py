"""The device that was asked for is the one that is used, or a warning says which one is."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch as th
from fake_envs import CounterEnv

from sb3_dreamer_urlb import DreamerV2, DrQv2
from sb3_dreamer_urlb.devices import UnknownDeviceError, known_device

ALGORITHMS = pytest.mark.parametrize("algorithm", [DreamerV2, DrQv2])


@pytest.fixture(autouse=True)
def without_cuda(monkeypatch):
    monkeypatch.setattr(th.cuda, "is_available", lambda: False)


@ALGORITHMS
@pytest.mark.parametrize("device", ["cuda", "cuda:1", th.device("cuda")])
def test_a_device_that_is_not_here(algorithm, device, tmp_path):
    message = f"device='{device}': torch .* finds no such device here, cpu is used"
    with pytest.warns(UserWarning, match=message) as told:
        model = algorithm("CnnPolicy", CounterEnv(9), preset="tiny", device=device)
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
        algorithm("CnnPolicy", CounterEnv(9), preset="tiny", device=device)


@pytest.mark.parametrize(
    ("device", "hint"),
    [
        ("gpu", ': torch calls it "cuda".'),
        ("GPU:1", ': torch calls it "cuda:1".'),
        ("metal", ': torch calls it "mps".'),
        ("cud", ". Did you mean 'cuda'?"),
        ("cuda:x", ". Did you mean 'cuda'?"),
        ("tpu", "."),
        ("nonsense", "."),
        (None, "."),
        (10**30, "."),
        (np.array([1, 2]), "."),
    ],
)
def test_a_device_that_torch_does_not_know(device, hint):
    with pytest.raises(UnknownDeviceError) as caught:
        known_device(device)
    expected = f'device must be "auto", "cpu", "cuda", "cuda:1" or another of torch\'s, got {device!r}{hint}'
    assert str(caught.value) == expected and isinstance(caught.value, ValueError) and isinstance(caught.value, RuntimeError)


@ALGORITHMS
def test_it_is_refused_wherever_a_device_is_taken(algorithm, tmp_path):
    model = algorithm("CnnPolicy", CounterEnv(9), preset="tiny", device="cpu")
    model.save(tmp_path / "model")
    model.policy.save(tmp_path / "policy")
    for take in (
        lambda: algorithm("CnnPolicy", CounterEnv(9), preset="tiny", device="gpu"),
        lambda: algorithm.load(tmp_path / "model", device="gpu"),
        lambda: type(model.policy).load(tmp_path / "policy", device="gpu"),
        lambda: setattr(model, "device", "gpu"),
    ):
        with pytest.raises(UnknownDeviceError, match='torch calls it "cuda"'):
            take()
