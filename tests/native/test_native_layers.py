"""Dense layers and samples that learn with kernels of our own are torch's, forward and backward, and so are dreams."""

from __future__ import annotations

import pytest
import torch as th
import torch.nn.functional as F
from operator_calls import ROUNDING, Calls

from sb3_dreamer_urlb import native
from sb3_dreamer_urlb.native import planner_ops, product_ops
from sb3_dreamer_urlb.nn import dense, distributions
from sb3_dreamer_urlb.nn.distributions import sample_one_hot

FORMATS = [th.float32, th.bfloat16]
PRODUCTS = ("rows_by_weights", "transposed_product", "lay_out_weights")


@pytest.fixture
def tiles(kernels):
    with native.using("native", "cpu"):
        if not product_ops.available():
            pytest.skip("this processor has no tiles (AMX)")
        yield


@pytest.fixture
def lanes(kernels, monkeypatch):
    """Kernels for samples, which are right on processors where torch's are faster, too."""
    monkeypatch.setattr(planner_ops, "fast", lambda: True)
    with native.using("native", "cpu"):
        yield


def _ours(calls: Calls) -> dict[str, int]:
    return {name.split(".")[1]: count for name, count in calls.counts.items() if name.startswith("sb3_dreamer_urlb.")}


def _near(found, exact, dtype, scale=4.0):
    """Of the largest number, because sums of both signs may cancel."""
    assert found.shape == exact.shape and found.dtype != th.float64
    assert (found.double() - exact).abs().max() <= scale * ROUNDING[dtype] * exact.abs().max()


# -- dense layers ----------------------------------------------------------------------------------------------------------


def _operands(*leading, inputs=70, outputs=45):
    its = th.randn(*leading, inputs), th.randn(outputs, inputs) / inputs**0.5, th.randn(outputs)
    return [operand.requires_grad_() for operand in its]


def _exact(x, weight, bias, dtype, elu):
    """In float64, of operands rounded to the format."""
    rounded = [None if part is None else part.detach().to(dtype).double() for part in (x, weight)]
    its = [*rounded, None if bias is None else bias.detach().double()]
    its = [None if part is None else part.requires_grad_() for part in its]
    y = F.linear(*its)
    return its, F.elu(y) if elu else y


@pytest.mark.parametrize("dtype", FORMATS)
@pytest.mark.parametrize("elu", [False, True])
@pytest.mark.parametrize("leading", [(300,), (20, 15), (3, 20, 5)], ids=str)
def test_values_and_gradients(tiles, seeded, leading, elu, dtype):
    operands = _operands(*leading)
    slope = th.randn(*leading, 45)
    with th.autocast("cpu", enabled=dtype == th.bfloat16), Calls() as calls:
        y = (dense.linear_elu if elu else dense.linear)(*operands)
        grads = th.autograd.grad(y, operands, slope.to(y.dtype))
    ours = _ours(calls)
    assert {name: ours.get(name) for name in PRODUCTS} == dict(zip(PRODUCTS, (2, 1, 2), strict=True))
    assert ours.get("elu_backward") == (1 if elu else None)
    theirs, exact = _exact(*operands, dtype, elu)
    assert y.dtype == dtype and all(grad.dtype == th.float32 for grad in grads)
    _near(y, exact, dtype)
    for grad, expected in zip(grads, th.autograd.grad(exact, theirs, slope.to(dtype).double()), strict=True):
        _near(grad, expected, dtype)


@pytest.mark.parametrize("elu", [False, True])
def test_gradients_are_slopes(tiles, seeded, elu):
    """Differences of values along random directions, of float32's coarseness."""
    operands = _operands(300)
    layer, slope = dense.linear_elu if elu else dense.linear, th.randn(300, 45)
    grads = th.autograd.grad(layer(*operands), operands, slope)
    for i, operand in enumerate(operands):
        direction, step = th.randn_like(operand), 1e-3
        ends = [[*operands[:i], operand.detach() + sign * step * direction, *operands[i + 1 :]] for sign in (1, -1)]
        with th.no_grad():
            up, down = ((layer(*end).double() * slope).sum() for end in ends)
        expected = (grads[i].double() * direction).sum()
        assert ((up - down) / (2 * step)).item() == pytest.approx(expected.item(), rel=2e-3, abs=0.05)


@pytest.mark.parametrize("dtype", FORMATS)
@pytest.mark.parametrize("layer", [dense.linear, dense.linear_elu])
def test_frozen_weights(tiles, seeded, layer, dtype):
    """Gradients pass through a frozen layer: only that of its input is computed."""
    x, weight, bias = _operands(300)
    weight.requires_grad_(False), bias.requires_grad_(False)
    with th.autocast("cpu", enabled=dtype == th.bfloat16), Calls() as calls:
        y = layer(x, weight, bias)
        y.sum().backward()
    ours = _ours(calls)
    assert ours["rows_by_weights"] == 2 and "transposed_product" not in ours
    assert weight.grad is None and bias.grad is None
    (its, *_), exact = _exact(x, weight, bias, dtype, layer is dense.linear_elu)
    _near(x.grad, th.autograd.grad(exact.sum(), its)[0], dtype)
    # And the other way round: inputs that nobody learns from.
    with Calls() as calls:
        layer(x.detach(), weight.requires_grad_(), bias.requires_grad_()).sum().backward()
    assert _ours(calls)["rows_by_weights"] == 1 and weight.grad is not None and bias.grad is not None


@pytest.mark.parametrize("dtype", FORMATS)
@pytest.mark.parametrize("columns", [slice(0, 50), slice(20, None), slice(None, None, 2)], ids=str)
def test_parts_of_a_layers_weights(tiles, seeded, columns, dtype):
    """As the RSSM reads them, without a bias."""
    x, weight, _ = _operands(300, inputs=96)
    x = x.detach()[:, : weight[:, columns].shape[1]].requires_grad_()  # of wider rows
    with th.autocast("cpu", enabled=dtype == th.bfloat16), Calls() as calls:
        y = dense.linear(x, weight[:, columns], None)
        x_grad, weight_grad = th.autograd.grad(y.float().square().sum(), [x, weight])
    assert _ours(calls)["rows_by_weights"] == 2 and _ours(calls)["transposed_product"] == 1
    (its_x, its_weight, _), exact = _exact(x, weight[:, columns], None, dtype, False)
    expected = th.autograd.grad(exact, [its_x, its_weight], (2 * y.float()).to(dtype).double())
    _near(y, exact, dtype)
    _near(x_grad, expected[0], dtype)
    _near(weight_grad[:, columns], expected[1], dtype)
    rest = th.ones(96, dtype=th.bool)
    rest[columns] = False
    assert not weight_grad[:, rest].any()


@pytest.mark.parametrize("layer", [dense.linear, dense.linear_elu])
def test_operands_that_lie_otherwise_in_memory(tiles, seeded, layer):
    x, weight, bias = _operands(300, inputs=64)
    expected = layer(x, weight, bias)
    assert th.equal(layer(x.T.contiguous().T, weight.T.contiguous().T, bias), expected)
    row = x[:1].expand(300, -1)
    assert th.allclose(layer(row, weight, bias), expected[:1].expand(300, -1), atol=1e-6)
    # A sum's gradient is one number for all.
    assert th.allclose(
        th.autograd.grad(layer(row, weight, bias).sum(), x)[0][0],
        300 * th.autograd.grad(layer(x, weight, bias)[0].sum(), x)[0][0],
        rtol=1e-4,
        atol=1e-2,
    )


def test_few_rows_stay_with_torch(tiles, seeded):
    for sizes in ((product_ops.ROWS - 1, 64, 64), (300, product_ops.COLUMNS - 1, 64), (300, 64, product_ops.COLUMNS - 1)):
        operands = _operands(sizes[0], inputs=sizes[1], outputs=sizes[2])
        with Calls() as calls:
            assert th.equal(dense.linear(*operands), F.linear(*operands))
        assert not _ours(calls)
    operands = _operands(300)
    with Calls() as calls:
        dense.linear(*(operand.double() for operand in operands))
        with native.using("eager", "cpu"):
            dense.linear(*operands)
    assert not _ours(calls)


# -- samples ---------------------------------------------------------------------------------------------------------------


def _logits(n=1000, variables=4, classes=8, dtype=th.float32):
    return (2 * th.randn(n, variables, classes)).to(dtype)


@pytest.mark.parametrize("dtype", FORMATS)
def test_samples_have_their_frequencies(lanes, seeded, dtype):
    logits = _logits(1, 3, 16, dtype).expand(20000, -1, -1)
    with Calls() as calls:
        drawn = sample_one_hot(logits, th.Generator().manual_seed(1))
    assert _ours(calls) == {"draws": 1, "one_hot": 1}
    assert drawn.dtype == dtype and drawn.shape == logits.shape
    assert (drawn.sum(-1) == 1).all() and ((drawn == 0) | (drawn == 1)).all()
    assert th.allclose(drawn.float().mean(0), logits[0].float().softmax(-1), atol=0.015)
    # From the generator, and from nothing else.
    again, other = (sample_one_hot(logits, th.Generator().manual_seed(seed)) for seed in (1, 2))
    assert th.equal(drawn, again) and not th.equal(drawn, other)


def test_samples_are_torchs_of_the_same_random_numbers(lanes, seeded):
    logits = _logits()
    ours = sample_one_hot(logits, th.Generator().manual_seed(1))
    with native.using("eager", "cpu"):
        theirs = sample_one_hot(logits, th.Generator().manual_seed(1))
    # But where a uniform number lies next to a step.
    assert (ours != theirs).any(-1).float().mean() < 1e-3


@pytest.mark.parametrize("classes", [8, 32, 37])
@pytest.mark.parametrize("dtype", FORMATS)
def test_samples_have_the_gradient_of_probabilities(lanes, seeded, dtype, classes):
    logits = _logits(20, 30, 40 * classes, dtype).view(20, 30, 40, classes).requires_grad_()  # time, batch, …
    slope = th.randn(logits.shape).to(dtype)
    with Calls() as calls:
        drawn = sample_one_hot(logits)
        for grad in (slope, slope.transpose(0, 1).contiguous().transpose(0, 1)):
            (found,) = th.autograd.grad(drawn, logits, grad, retain_graph=True)
            exact = logits.detach().double().requires_grad_()
            (expected,) = th.autograd.grad(exact.softmax(-1), exact, slope.double())
            assert found.dtype == dtype
            error = (found.double() - expected).abs()
            assert (error <= 2e-6 * slope.abs().max() + ROUNDING[dtype] * expected.abs()).all()
    assert _ours(calls) == {"draws": 1, "one_hot": 1, "softmax_backward": 2}
    assert th.equal(
        sample_one_hot(logits.detach(), th.Generator().manual_seed(5)), sample_one_hot(logits, th.Generator().manual_seed(5))
    )


def test_few_samples_and_other_machines_stay_with_torch(lanes, seeded, monkeypatch):
    few = th.randn(distributions.NATIVE_SIZE // 8 - 1, 1, 8)
    enough = th.randn(distributions.NATIVE_SIZE // 8, 1, 8)
    for logits, ours in ((few, False), (enough, True)):
        with Calls() as calls:
            sample_one_hot(logits)
        assert bool(_ours(calls)) == ours
    with native.using("eager", "cpu"), Calls() as calls:
        sample_one_hot(enough)
    monkeypatch.setattr(planner_ops, "fast", lambda: False)
    with calls:
        sample_one_hot(enough)
    assert not _ours(calls)


@pytest.mark.parametrize("grad", [th.randn(6, 8).double(), th.randn(8, 6).T, th.randn(6, 9)])
def test_what_the_gradient_does_not_take(lanes, grad):
    with pytest.raises((TypeError, ValueError), match=r"torch.float64|numbers must lie .* \(1, 6\)|probabilities must be .*9"):
        planner_ops.softmax_backward(grad, th.rand(6, 8))


# -- dreams ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_dreams_are_seen_in_the_format_of_products(learner, batch, precision):
    its = learner(None, precision=precision)
    model, start = its.agent.world_model, its.agent.world_model.rssm.initial(7)
    with its._products():
        dreams = model.imagine(its.agent.actor, start, 3)
    assert dreams.seen.dtype == its.dtype and dreams.seen.shape == (4, 7, 20)
    assert dreams.feature.dtype == th.float32 and th.equal(dreams.feature.to(its.dtype), dreams.seen)
    # What is rounded is only what is seen: gradients go back through it, and one-hots are themselves.
    stoch = dreams.seen[1:, :, : model.rssm.stoch_size].unflatten(-1, model.rssm.logits_shape)
    assert th.equal(stoch.float().sum(-1), th.ones(3, 7, 3))
    dreams.feature[-1].sum().backward()
    assert all(parameter.grad.abs().sum() > 0 for parameter in its.agent.actor.parameters())
