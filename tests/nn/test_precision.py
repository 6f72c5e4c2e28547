"""Formats of products: who decides, what stays float32, and that both learn the same."""

from __future__ import annotations

import copy
import os
import subprocess
import sys

import pytest
import torch as th
from tiny import infer
from torch import nn

from sb3_dreamer_urlb import DreamerV2
from sb3_dreamer_urlb.behavior import actor_critic
from sb3_dreamer_urlb.learning import memory
from sb3_dreamer_urlb.nn import nets, precision
from sb3_dreamer_urlb.world_model import convolution, decoder, encoder, rssm
from sb3_dreamer_urlb.world_model.convolution_forms import Direct, Patches, PatchesAndPhases, Phases, PhasesOnce


@pytest.fixture
def short_products(monkeypatch):
    """A function that says by which of torch's names the CPU has products of bfloat16, and that torch uses them."""

    def say(has):
        for name in ("_is_amx_tile_supported", "_is_avx512_bf16_supported"):
            monkeypatch.setattr(th.cpu, name, lambda name=name: name == has)
        monkeypatch.setattr(precision, "cpu_multiplies_short", lambda: True)

    return say


def test_auto_asks_for_hardware_and_size(short_products):
    small, large = precision.AUTO_FEATURE_SIZE["update"] - 1, precision.AUTO_FEATURE_SIZE["update"]
    for has, size, device, expected in (
        ("_is_amx_tile_supported", large, "cpu", th.bfloat16),
        ("_is_avx512_bf16_supported", large, "cpu", th.bfloat16),
        ("_is_amx_tile_supported", small, "cpu", th.float32),
        ("_is_avx512_bf16_supported", small, "cpu", th.float32),
        ("neither", large, "cpu", th.float32),
        ("_is_amx_tile_supported", large, "cuda", th.float32),
    ):
        short_products(has)
        assert precision.choose("auto", "update", device, size) == expected
        assert precision.choose("float32", "update", device, size) == th.float32
        assert precision.choose("bfloat16", "update", device, size) == th.bfloat16


def test_the_argument_reaches_learner_and_planner_and_is_saved(tiny_model, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(precision, "cpu_multiplies_short", lambda: True)
    assert tiny_model().learner.dtype == th.float32  # too small to gain anything
    model = tiny_model(planner="dyna_mpc", precision="bfloat16", verbose=1)
    assert "bfloat16" in capsys.readouterr().out
    model.save(tmp_path / "model")
    for its in (model, DreamerV2.load(tmp_path / "model")):
        assert its.precision == "bfloat16"
        assert its.learner.dtype == its.policy.planner_dtype == th.bfloat16
    assert DreamerV2.load(tmp_path / "model", precision="float32").learner.dtype == th.float32


@pytest.mark.parametrize("value", ["half", None, th.bfloat16])
def test_an_unknown_precision_is_refused(tiny_model, value):
    with pytest.raises(ValueError, match=r"precision must be one of .*auto.*float32.*bfloat16"):
        tiny_model(precision=value)


@pytest.mark.parametrize("intrinsic", ["icm", "plan2explore", "rnd", "lbs", "apt", None])
def test_products_are_short_all_else_is_float32(learner, batch, intrinsic, monkeypatch):
    before, after = set(), set()

    def spying_full(x):
        before.add(x.dtype)
        after.add(precision.full(x).dtype)
        return precision.full(x)

    for module in (nets, actor_critic, decoder, encoder, rssm):
        monkeypatch.setattr(module, "full", spying_full)
    its = learner(intrinsic, discount_head=True, precision="bfloat16")
    metrics = its.update(batch)
    assert before == {th.bfloat16} and after == {th.float32}
    assert all(value.dtype == th.float32 and value.isfinite() for value in metrics.values())
    assert all(parameter.dtype == th.float32 for parameter in its.agent.parameters())
    for optimizer in its.optimizers().values():
        assert all(moment.dtype == th.float32 for state in optimizer.adam.state.values() for moment in state.values())
    with its._products():
        posterior = infer(its.agent.world_model, batch)
        imagination = its.agent.world_model.imagine(its.agent.actor, posterior.state.flatten().detach(), 3)
    tensors = [posterior.state.stoch, posterior.state.deter, posterior.embed, posterior.post_logits, posterior.prior_logits]
    tensors += [posterior.kl, imagination.feature, imagination.action, imagination.entropy]
    assert all(tensor.dtype == th.float32 for tensor in tensors)


@pytest.mark.parametrize("intrinsic", ["diayn", "aps"])
def test_methods_with_skills_learn_in_short_products(tiny_model, intrinsic):
    model = tiny_model(intrinsic_reward=intrinsic, precision="bfloat16").learn(40)
    assert model.phase_updates > 0
    assert all(value.dtype == th.float32 and value.isfinite() for value in model._metrics.sums.values())


def test_both_learn_the_same(learner, batch):
    """The same short run in both formats: the losses fall alike. Draws differ after a while, so losses do by a little."""
    curves = {}
    for dtype in ("float32", "bfloat16"):
        th.manual_seed(3)
        its = learner("lbs", precision=dtype)
        curves[dtype] = [its.update(batch) for _ in range(60)]

    def tail(dtype, name):
        return th.stack([metrics[name] for metrics in curves[dtype][-10:]]).mean().item()

    for name in ("image_loss", "intrinsic_loss", "reward_loss", "critic_loss"):
        first, ours, theirs = curves["float32"][0][name].item(), tail("bfloat16", name), tail("float32", name)
        assert abs(ours - theirs) < max(0.1 * abs(first - theirs), 0.02 * abs(theirs)), (name, first, ours, theirs)


def test_the_format_is_not_always_the_same(learner, batch):
    """Or the test above would compare a run with itself."""
    losses = []
    for dtype in ("float32", "bfloat16"):
        th.manual_seed(3)
        losses.append(learner("lbs", precision=dtype).update(batch)["image_loss"])
    assert losses[0] != losses[1]


# -- convolutions as products ----------------------------------------------------------------------------------------------

LAYERS = [
    (nn.Conv2d(3, 5, 4, 2), 6),
    (nn.Conv2d(3, 5, 4, 2), 7),  # sizes that leave a last row unseen
    (nn.Conv2d(3, 5, 4, 2), 12),
    (nn.ConvTranspose2d(3, 5, 5, 2), 5),
    (nn.ConvTranspose2d(3, 5, 6, 2), 2),
    (nn.ConvTranspose2d(3, 5, 6, 2), 7),  # phases
    (nn.ConvTranspose2d(3, 5, 5, 2), 7),  # neither
]


@pytest.mark.parametrize(("layer", "size"), LAYERS)
def test_every_form_equals_the_convolution(seeded, layer, size):
    layer = copy.deepcopy(layer).double()
    x = th.randn(4, 3, size, size, dtype=th.float64, requires_grad=True)
    ours, theirs = convolution.convolve(layer, x), layer(x)
    assert ours.grad_fn.name() == "_ConvolutionBackward"
    slope = th.randn_like(theirs)
    inputs = (x, *layer.parameters())
    grads = [th.autograd.grad(y, inputs, slope) for y in (ours, theirs)]
    assert th.allclose(ours, theirs)
    assert all(th.allclose(a, b) for a, b in zip(*grads, strict=True))


@pytest.mark.parametrize(
    ("dtype", "side", "form"),
    [
        (th.float32, 5, Patches),
        (th.float32, 6, PhasesOnce),
        (th.bfloat16, 4, Patches),
        (th.bfloat16, 5, PatchesAndPhases),
        (th.bfloat16, 6, PatchesAndPhases),
        (th.bfloat16, 7, Phases),
    ],
)
@pytest.mark.parametrize("kernel", [5, 6])
def test_transposed_convolutions_take_the_form_of_their_size(dtype, side, kernel, form):
    found = convolution._form(nn.ConvTranspose2d(3, 5, kernel, 2), th.zeros(1, 3, side, side), dtype)
    assert type(found) is (Direct if kernel == 5 and form in (Phases, PhasesOnce) else form)


@pytest.mark.parametrize(
    ("dtype", "side", "form"),
    [
        (th.float32, 12, Patches),
        (th.float32, 14, type(None)),
        (th.bfloat16, 10, Patches),
        (th.bfloat16, 14, PatchesAndPhases),
        (th.bfloat16, 16, type(None)),
    ],
)
def test_convolutions_take_the_form_of_their_size(dtype, side, form):
    assert type(convolution._form(nn.Conv2d(3, 5, 4, 2), th.zeros(1, 3, side, side), dtype)) is form


@pytest.mark.parametrize("form", [Direct, Patches, PatchesAndPhases, Phases, PhasesOnce])
def test_the_passes_of_a_form_work_for_both_kinds(seeded, form):
    """Also those that no layer of today uses."""
    its, weight = form(4, 2), th.randn(3, 5, 4, 4, dtype=th.float64, requires_grad=True)
    wide = th.randn(2, 5, 13, 13, dtype=th.float64)  # the last row is not seen
    narrow = nn.functional.conv2d(wide, weight, stride=2)
    slope = th.randn_like(narrow)
    assert th.allclose(its.gather(its.lay_out(wide), weight, None), narrow)
    assert th.allclose(its.weight(its.lay_out(wide), slope), *th.autograd.grad(narrow, weight, slope))
    assert th.allclose(its.scatter(slope, weight, None), nn.functional.conv_transpose2d(slope, weight, stride=2))


@pytest.mark.parametrize(("kernel", "bias"), [(5, None), (5, th.randn(5)), (4, th.randn(5))])
def test_phases_of_any_kernel(seeded, kernel, bias):
    narrow, weight = th.randn(2, 3, 6, 6), th.randn(3, 5, kernel, kernel)
    ours = PatchesAndPhases(kernel, 2).scatter(narrow, weight, bias)
    theirs = nn.functional.conv_transpose2d(narrow, weight, bias, stride=2)
    assert th.allclose(ours, theirs, atol=1e-5) and ours.is_contiguous(memory_format=th.channels_last)


def test_large_images_and_inference_stay_with_the_layer(seeded):
    layer = nn.Conv2d(3, 5, 4, 2)
    assert convolution.convolve(layer, th.randn(2, 3, 14, 14)).grad_fn.name() == "ConvolutionBackward0"
    with th.no_grad():
        x = th.randn(2, 3, 6, 6)
        assert th.equal(convolution.convolve(layer, x), layer(x))


# -- memory ----------------------------------------------------------------------------------------------------------------


@pytest.fixture
def unset():
    """The setting is made once; a test begins before that."""
    memory.keep_freed_memory.cache_clear()
    yield
    memory.keep_freed_memory.cache_clear()


def test_memory_is_kept_unless_the_user_says_no(unset, monkeypatch, tiny_model):
    monkeypatch.setenv(memory.SWITCH, "0")
    assert not memory.keep_freed_memory()
    memory.keep_freed_memory.cache_clear()
    monkeypatch.delenv(memory.SWITCH)
    tiny_model()
    assert memory.keep_freed_memory.cache_info().misses == 1  # the learner has asked


def test_freed_memory_costs_no_page_faults(unset):
    """In a process of its own: the setting cannot be taken back."""
    code = """
import resource, torch
from sb3_dreamer_urlb.learning import memory
kept = memory.keep_freed_memory()
def faults():
    # tensors that live and die as in an update: some stay until its end
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    held = [torch.ones(n * 2**20) for n in (16, 3, 9, 12, 5)]
    for n in (11, 2, 14):
        torch.ones(n * 2**20)
    held.clear()
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
first = [faults() for _ in range(10)]
print(kept, sum(faults() for _ in range(5)))
"""

    def run(switch):
        environment = {**os.environ, memory.SWITCH: switch}
        output = subprocess.run(
            [sys.executable, "-c", code],
            env=environment, check=True, capture_output=True, text=True,
        ).stdout  # fmt: skip
        kept, faults = output.split()
        return kept == "True", int(faults)

    kept, faults = run("1")
    if not kept:
        pytest.skip("not glibc")
    assert faults < run("0")[1] / 10


def test_another_c_library_is_left_alone(unset, monkeypatch):
    class Musl:
        def __init__(self, name):
            pass

    monkeypatch.setattr(memory.ctypes, "CDLL", Musl)
    assert not memory.keep_freed_memory()
    memory.keep_freed_memory.cache_clear()
    monkeypatch.setattr(memory.sys, "platform", "darwin")
    assert not memory.keep_freed_memory()
