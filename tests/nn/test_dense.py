"""Products whose weight gradients take another way on CPUs are torch's products."""

from __future__ import annotations

import pytest
import torch as th
import torch.nn.functional as F

from sb3_dreamer_urlb.nn import dense


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    monkeypatch.setattr(dense, "ROWS", 8)
    monkeypatch.setattr(dense, "INPUTS", 8)


def _operands(outputs, *leading):
    x, weight, bias = th.randn(*leading, 24), th.randn(outputs, 24), th.randn(outputs)
    return [operand.requires_grad_() for operand in (x, weight, bias)]


@pytest.mark.parametrize("outputs", [16, 40])
def test_value_and_gradients(seeded, outputs):
    """Either operand may be the narrower one; inputs of several dimensions."""
    operands = _operands(outputs, 5, 8)
    slope = th.randn(5, 8, outputs)
    with th.autocast("cpu", th.bfloat16):
        ours, theirs = dense.linear(*operands), F.linear(*operands)
    assert "_Linear" in ours.grad_fn.next_functions[0][0].name()
    assert th.equal(ours, theirs)
    grads = [th.autograd.grad(y, operands, slope.to(y.dtype)) for y in (ours, theirs)]
    for a, b in zip(*grads, strict=True):
        assert a.dtype == th.float32 and th.allclose(a, b, atol=0.02 * b.abs().max())


def test_torch_keeps_the_rest(seeded):
    x, weight, bias = _operands(16, 40)
    assert th.equal(dense.linear(x, weight, bias), F.linear(x, weight, bias))  # float32
    with th.autocast("cpu", th.bfloat16):
        for few in (x[:7], x.detach()[:7]):
            assert dense.linear(few, weight, bias).grad_fn.name() == "AddmmBackward0"
        # No gradient of the weight, which is what takes another way.
        assert dense.linear(x, weight.detach(), bias.detach()).grad_fn.name() == "AddmmBackward0"
        with th.no_grad():
            assert not dense.linear(x, weight, bias).requires_grad


@pytest.mark.parametrize(("dtype", "columns"), [(th.float32, 20), (th.bfloat16, 20), (th.bfloat16, 3)])
def test_column_sums(seeded, dtype, columns):
    x = th.randn(500, columns).to(dtype)
    sums = dense.column_sums(x)
    assert sums.shape == (columns,) and sums.dtype == dtype
    assert th.allclose(sums.float(), x.float().sum(0), rtol=2**-7, atol=1e-3)
