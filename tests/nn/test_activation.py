"""ELU by cheaper arithmetic is torch's, within a rounding of 1."""

from __future__ import annotations

import pytest
import torch as th
import torch.nn.functional as F

from sb3_dreamer_urlb.nn import activation

SPECIAL = [0.0, -0.0, float("inf"), -float("inf"), float("nan"), 1e-30, -1e-30, -100.0, 100.0]
#: a rounding of 1 in float32, and one of the result
ROUNDING = {th.float32: 1.2e-7, th.bfloat16: 2**-9}
#: more than a piece and not a multiple of one
SIZE = 2 * activation.PIECE + 1


def elu(x):
    return activation.elu_(x.clone())


def _numbers(dtype, size=SIZE):
    x = 3 * th.randn(size, generator=th.Generator().manual_seed(0))
    x[: len(SPECIAL)] = th.tensor(SPECIAL)
    return x.to(dtype)


@pytest.mark.parametrize("size", [activation.SMALLEST, SIZE])
@pytest.mark.parametrize("dtype", ROUNDING)
def test_it_is_elu(dtype, size):
    x = _numbers(dtype, size)
    before, expected = x.clone(), F.elu(x)
    ours = elu(x)
    assert th.allclose(ours, expected, rtol=0, atol=ROUNDING[dtype], equal_nan=True)
    assert th.allclose(ours[x > 0], x[x > 0], rtol=0, atol=6e-8)
    assert th.equal(x.nan_to_num(), before.nan_to_num())
    assert activation.elu_(x) is x and th.equal(x.nan_to_num(), ours.nan_to_num())


@pytest.mark.parametrize("dtype", ROUNDING)
def test_gradient(dtype):
    x = _numbers(dtype)[len(SPECIAL) :].requires_grad_()
    slope = th.randn_like(x)
    ours, theirs = elu(x), F.elu(x)
    assert ours.grad_fn.name() == "_ELUBackward"
    ours, theirs = (th.autograd.grad(y, x, slope)[0] for y in (ours, theirs))
    assert (ours - theirs).abs().max() <= 3 * ROUNDING[dtype] * slope.abs().max()


@pytest.mark.parametrize("dtype", ROUNDING)
@pytest.mark.parametrize("size", [100, SIZE])
def test_overwriting_keeps_the_gradient(dtype, size):
    """Also of what another function gave out as a view."""
    x = _numbers(dtype, size + len(SPECIAL))[len(SPECIAL) :].requires_grad_()
    for before in (lambda x: x + 1, lambda x: (x + 1).view(-1, 1).squeeze(1)):
        inputs = before(x), before(x)
        kept = inputs[1].detach().clone()
        ours, theirs = activation.elu_(inputs[0]), elu(inputs[1])
        slopes = [th.autograd.grad(y, x, th.ones_like(y))[0] for y in (ours, theirs)]
        assert th.equal(ours, theirs) and th.equal(*slopes)
        assert th.equal(inputs[1], kept) and (size < activation.SMALLEST or th.equal(inputs[0], ours))


def test_memory_layouts():
    x = th.randn(2, 16, 64, 64)
    assert x.numel() >= activation.SMALLEST
    for laid_out in (x, x.contiguous(memory_format=th.channels_last), x.transpose(0, 2), x[:, ::2]):
        ours = elu(laid_out)
        assert th.allclose(ours, F.elu(laid_out), atol=1e-6)
        assert ours.stride() == F.elu(laid_out).stride()


@pytest.mark.parametrize("x", [th.randn(100), th.randn(activation.SMALLEST, dtype=th.float64)], ids=["small", "double"])
def test_torch_keeps_the_rest(x):
    assert th.equal(elu(x), F.elu(x)) and th.equal(activation.elu_(x.clone()), F.elu(x))
