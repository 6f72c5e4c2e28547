"""A processor with AVX2 and nothing newer, as most laptops have: this one with the rest hidden, in processes of their own."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys

import every_combination
import pytest
import torch as th
from fake_envs import CounterEnv
from places import HELPERS, PYTHONPATH
from told import told_meanwhile

from sb3_dreamer_urlb import DreamerV2
from sb3_dreamer_urlb.nn import precision
from sb3_dreamer_urlb.planning.prepared.prepacked import PrepackedLinear

pytestmark = pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="AVX2 is x86's")


def masked(*command):
    environment = {**os.environ, **every_combination.MASKED, "PYTHONPATH": PYTHONPATH, "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, *command], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def test_every_combination_runs(kernels):
    found = json.loads(masked(HELPERS / "every_combination.py"))
    assert found["torch"] == "AVX2" and not found["short"] and not found["lanes"] and not found["tiles"]
    assert found["native"]  # ours are compiled for it, too
    assert not found["faults"], "\n".join(found["faults"])
    slow = [warning for warning in found["warnings"] if "is slow here" in warning]
    assert len(slow) == 1 and "'bfloat16', 'auto'" in slow[0] and 'precision="auto"' in slow[0]
    assert all("cuda_graphs" in warning for warning in found["warnings"] if warning not in slow)


def test_auto_never_takes_what_is_slow_there():
    code = "from sb3_dreamer_urlb.nn import precision as p; print({p.choose('auto', part, 'cpu', 10**6) for part in %r})"
    assert masked("-c", code % list(precision.AUTO_FEATURE_SIZE)) == "{torch.float32}\n"


@pytest.fixture
def slow_at_bfloat16(monkeypatch):
    """In this process, the same question answered with no."""
    for module in ("nn.precision", "planning.prepared.prepacked"):
        monkeypatch.setattr(f"sb3_dreamer_urlb.{module}.cpu_multiplies_short", lambda: False)
    precision._warn_of_slow_products.cache_clear()
    yield
    precision._warn_of_slow_products.cache_clear()


def test_asking_for_it_warns_once_and_on_a_gpu_not_at_all(slow_at_bfloat16):
    with told_meanwhile() as said:
        assert precision.choose("bfloat16", "update", "cuda", 8) == th.bfloat16
    assert not said
    with told_meanwhile() as said:
        assert (
            precision.choose("bfloat16", "update", "cpu", 8)
            == precision.choose("bfloat16", "planner", "cpu", 8)
            == th.bfloat16
        )
    assert len(said) == 1 and "slow here" in said[0]


@pytest.mark.parametrize("asked", precision.PRECISIONS)
def test_a_file_of_a_faster_processor_takes_what_is_fast_here(tiny_model, tmp_path, request, asked):
    model = tiny_model(CounterEnv(), precision=asked)
    model.save(tmp_path / "model.zip")
    model.policy.save(tmp_path / "policy.zip")
    request.getfixturevalue("slow_at_bfloat16")
    for load, path, given in (
        (DreamerV2.load, "model.zip", {"precision": "bfloat16"}),
        (type(model.policy).load, "policy.zip", {"custom_objects": {"precision": "bfloat16"}}),
    ):
        with told_meanwhile() as said:
            assert load(tmp_path / path).precision == ("auto" if asked == "bfloat16" else asked)
        assert len(said) == (asked == "bfloat16") and all("give it again" in text for text in said)
        with told_meanwhile() as said:
            assert load(tmp_path / path, **given).precision == "bfloat16"
        assert not any("give it again" in text for text in said)


@pytest.mark.parametrize("widens", [True, False])
def test_avx512_without_products_of_it_warns_too(monkeypatch, widens):
    for name, has in (("amx_tile", False), ("avx512_bf16", not widens), ("avx512", True)):
        monkeypatch.setattr(th.cpu, f"_is_{name}_supported", lambda has=has: has)
    monkeypatch.setattr(precision, "cpu_multiplies_short", lambda: True)
    precision._warn_of_slow_products.cache_clear()
    with told_meanwhile() as said:
        for part in ("update", "planner"):
            assert precision.choose("bfloat16", part, "cpu", 8) == th.bfloat16
    precision._warn_of_slow_products.cache_clear()
    assert len(said) == widens and all("two to three times as long as float32" in text for text in said)
    assert precision.choose("auto", "update", "cpu", 10**6) == (th.float32 if widens else th.bfloat16)


def test_planners_products_are_rounded_alike_whoever_multiplies(slow_at_bfloat16, seeded):
    weight, bias, plus, x = th.randn(30, 40), th.randn(30), th.randn(7, 30).bfloat16(), th.randn(7, 40).bfloat16()
    layer = PrepackedLinear(weight, bias, th.bfloat16)
    expected = x.double() @ weight.bfloat16().double().T + bias.bfloat16().double()
    assert th.equal(layer(x), expected.float().bfloat16())
    assert layer(x, plus).dtype == th.bfloat16
    assert th.allclose(layer(x, plus).double(), expected + plus.double(), rtol=2**-8, atol=1e-5)
    assert th.equal(precision.multiply(x, weight.bfloat16().T), (x.double() @ weight.bfloat16().double().T).float().bfloat16())
