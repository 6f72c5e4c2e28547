"""The GRU of dreams by kernels of our own is torch's, forward and backward."""

from __future__ import annotations

import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st
from tiny import threads_of
from torch import nn

from sb3_dreamer_urlb import native
from sb3_dreamer_urlb.world_model import gru

#: roundings of what is computed in float32; parts' gradients are rounded to their format
ERROR = {th.float32: 5e-6, th.bfloat16: 2**-8}


def _norm(size: int, learns: bool = False) -> nn.LayerNorm:
    norm = nn.LayerNorm(3 * size)
    nn.init.normal_(norm.weight, 1, 0.3)
    nn.init.normal_(norm.bias, 0, 0.3)
    return norm.requires_grad_(learns)


def _inputs(rows: int, size: int, dtype: th.dtype) -> tuple[th.Tensor, th.Tensor, th.Tensor]:
    parts = (3 * th.randn(rows, 3 * size)).to(dtype).requires_grad_()
    return parts, th.randn(rows, size, requires_grad=True), th.randn(rows, size)


@pytest.fixture(autouse=True)
def lanes(kernels, monkeypatch):
    monkeypatch.setattr(native, "on_lanes", native.active)
    monkeypatch.setattr(gru, "NATIVE_ROWS", 1)


@pytest.mark.parametrize("dtype", ERROR)
@given(rows=st.integers(1, 70), size=st.integers(1, 70), threads=st.integers(1, 2))
def test_it_is_torchs(dtype, rows, size, threads):
    th.manual_seed(rows * 71 + size)
    norm, (parts, old, slope) = _norm(size), _inputs(rows, size, dtype)
    with threads_of(threads), native.using("native", "cpu"):
        ours = gru.recur(parts, norm, old)
        gradients = th.autograd.grad(ours, [parts, old], slope)
    theirs = gru.recur(parts, norm, old)
    expected = th.autograd.grad(theirs, [parts, old], slope)
    assert ours.grad_fn.name() == "_GatesBackward" != theirs.grad_fn.name()
    assert (ours - theirs).abs().max() <= ERROR[th.float32]
    for gradient, other in zip(gradients, expected, strict=True):
        assert gradient.dtype == other.dtype and gradient.shape == other.shape
        # Of few numbers a row, the norm makes anything of a rounding.
        tolerance = ERROR[gradient.dtype] * max(1.0, other.abs().max().item()) * (1 if size > 2 else 1e3)
        assert (gradient.float() - other.float()).abs().max() <= tolerance


def test_a_norm_that_learns_is_left_to_torch():
    norm, (parts, old, _) = _norm(8, learns=True), _inputs(5, 8, th.float32)
    with native.using("native", "cpu"):
        new = gru.recur(parts, norm, old)
    assert new.grad_fn.name() != "_GatesBackward"
    assert th.autograd.grad(new.sum(), norm.weight)[0].abs().sum() > 0


def test_what_is_not_a_number_stays_so_and_in_its_row():
    norm, (parts, old, _) = _norm(20), _inputs(4, 20, th.float32)
    parts = parts.detach().clone()
    parts[1, 3] = float("nan")
    with native.using("native", "cpu"):
        new = gru.recur(parts, norm, old.detach())
    assert new[1].isnan().all() and not new[[0, 2, 3]].isnan().any()
