"""Convolutions, images and their loss by kernels of our own are torch's within roundings."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch as th
import torch.nn.functional as F
from gymnasium import spaces
from operator_calls import ROUNDING, Calls
from torch import nn

from sb3_dreamer_urlb import native
from sb3_dreamer_urlb.native import image_ops, pixel_ops, product_ops
from sb3_dreamer_urlb.nn import distributions
from sb3_dreamer_urlb.spaces.observations import Images
from sb3_dreamer_urlb.world_model import convolution

#: channels and size of the wide image, channels of the narrow one, kernel, stride, images
SHAPES = [
    (3, (9, 9), 5, (4, 4), 2, 30),
    (3, (64, 64), 48, (4, 4), 2, 2),
    (48, (31, 31), 96, (4, 4), 2, 2),  # a last line and a last pixel unseen
    (96, (13, 13), 192, (5, 5), 2, 12),  # a kernel that is no multiple of the stride
    (3, (30, 17), 20, (6, 3), 2, 3),
    (7, (8, 9), 33, (2, 3), 3, 40),  # pixels that no window sees
    (40, (6, 6), 70, (4, 4), 2, 65),
    (2, (4, 9), 3, (1, 4), 2, 50),
    (16, (12, 12), 8, (5, 5), 1, 5),
    (5, (6, 6), 32, (4, 4), 2, 70),  # windows whose lines are whole steps, images that are not
    (48, (7, 13), 64, (5, 3), 2, 33),
    (3, (11, 12), 32, (4, 4), 3, 40),
    (70, (5, 5), 130, (5, 5), 5, 40),  # a single pixel
    (3, (64, 64), 48, (6, 6), 2, 3),  # lines of the grid that fill panels
    (5, (14, 60), 20, (3, 4), 2, 3),
    (3, (20, 84), 40, (8, 8), 3, 3),
]


@pytest.fixture
def tiles(kernels):
    with native.using("native", "cpu"):
        if not product_ops.worthwhile(10**6, 32, 32):
            pytest.skip("this processor has no tiles")
        yield


def _near(found, exact, dtype, scale=2.0):
    assert found.shape == exact.shape and (found.double() - exact).abs().max() <= scale * ROUNDING[dtype] * exact.abs().max()


def _image(*shape, dtype, seed=0):
    x = th.randn(shape, generator=th.Generator().manual_seed(seed))
    return x.to(dtype).contiguous(memory_format=th.channels_last)


@pytest.mark.parametrize("dtype", ROUNDING)
@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_passes_of_a_convolution(tiles, threads, shape, dtype):
    channels, size, n, kernel, stride, images = shape
    wide, bias = _image(images, channels, *size, dtype=dtype), th.randn(n)
    weight = _image(n, channels, *kernel, dtype=dtype, seed=1).contiguous()
    exact = F.conv2d(wide.double(), weight.double(), bias.double(), stride)
    _near(image_ops.gather(wide, weight, stride, bias, False), exact, dtype, 8)
    _near(image_ops.gather(wide, weight, stride, bias, True), F.elu(exact), dtype, 8)
    narrow, bias = _image(*exact.shape, dtype=dtype, seed=2), th.randn(channels)
    its = weight.double().requires_grad_()
    (slope,) = th.autograd.grad(F.conv2d(wide.double(), its, None, stride), its, narrow.double())
    found = image_ops.weight_gradient(wide, narrow, kernel, stride)
    assert found.dtype == th.float32
    _near(found, slope, th.float32, 10)
    exact = F.conv_transpose2d(narrow.double(), weight.double(), None, stride)
    seen = exact.shape[2:]
    _near(image_ops.scatter(narrow, weight, stride, seen, bias, True), F.elu(exact + bias.view(-1, 1, 1)), dtype, 8)
    exact = F.pad(exact, (0, size[1] - seen[1], 0, size[0] - seen[0]))
    found = image_ops.scatter(narrow, weight, stride, size, None, False)
    assert found.dtype == dtype and found.is_contiguous(memory_format=th.channels_last)
    _near(found, exact, dtype, 8)


@pytest.mark.parametrize("dtype", ROUNDING)
@pytest.mark.parametrize("elu", [False, True])
@pytest.mark.parametrize("kind", [nn.Conv2d, nn.ConvTranspose2d])
@pytest.mark.parametrize(("kernel", "size"), [(4, (14, 14)), (5, (7, 7)), ((3, 2), (9, 6))], ids=str)
def test_layers_on_tiles(tiles, seeded, monkeypatch, kind, kernel, size, elu, dtype):
    monkeypatch.setattr(convolution, "CHANNELS", 1)
    ours = kind(6, 10, kernel, 2)
    theirs = copy.deepcopy(ours)
    x = th.randn(80, 6, *size)
    slope = found = None
    results = []
    for layer, compile in ((ours, "native"), (theirs, "eager")):
        leaf = x.clone().requires_grad_()
        with native.using(compile, "cpu"), th.autocast("cpu", enabled=dtype == th.bfloat16), Calls() as calls:
            y = (convolution.convolve_elu if elu else convolution.convolve)(layer, leaf)
            slope = th.randn_like(y) if slope is None else slope
            found = th.autograd.grad(y, [leaf, *layer.parameters()], slope)
        its = {name for name in calls.counts if name.startswith("sb3_dreamer_urlb.image")}
        assert len(its) == (3 if compile == "native" else 0)
        assert y.dtype == dtype and all(grad.dtype == th.float32 for grad in found)
        results.append((y, *found))
    for i, (a, b) in enumerate(zip(*results, strict=True)):
        # Gradients of parameters are sums over up to 80 · 30 · 30 places, in another order.
        slack = 16 if i < 2 else 64
        assert a.shape == b.shape and (a - b).abs().max() <= slack * ROUNDING[dtype] * b.abs().max()


def test_only_what_is_asked_for(tiles, seeded):
    """A first convolution needs no gradient of its input; frozen ones none of their weights."""
    layer, x = nn.Conv2d(3, 8, 4, 2), th.randn(20, 3, 14, 14)
    with Calls() as calls:
        convolution.convolve_elu(layer, x).sum().backward()
    assert calls.counts["sb3_dreamer_urlb.image_scatter.default"] == 0 and layer.weight.grad is not None
    layer.requires_grad_(False)
    with Calls() as calls:
        convolution.convolve_elu(layer, x.requires_grad_()).sum().backward()
    assert calls.counts["sb3_dreamer_urlb.image_weight.default"] == 0 and x.grad is not None


@pytest.mark.parametrize(
    ("layer", "x"),
    [
        (nn.Conv2d(3, 5, 4, (2, 1)), th.randn(20, 3, 16, 16)),  # stride
        (nn.Conv2d(3, 5, 4, 2), th.randn(2, 3, 16, 16)),  # few pixels
        (nn.Conv2d(3, 5, 4, 2).double(), th.randn(20, 3, 16, 16).double()),
    ],
)
def test_others_stay_with_torch(tiles, layer, x):
    with Calls() as calls:
        y = convolution.convolve_elu(layer, x)
    assert not any(name.startswith("sb3_dreamer_urlb.image") for name in calls.counts)
    assert th.allclose(y, F.elu(layer(x)), atol=1e-5)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda x, w: image_ops.gather(x.contiguous(), w, 2, None, False), "4 channels, last in memory"),
        (lambda x, w: image_ops.gather(x, w[:, :3], 2, None, False), "3 channels, last in memory"),
        (lambda x, w: image_ops.gather(x, w, 2, th.randn(4), False), "a bias for 5 outputs cannot be"),
        (lambda x, w: image_ops.scatter(x, w, 2, (20, 20), None, False), "5 channels, last in memory"),
        (lambda x, w: image_ops.weight_gradient(x, x, (4, 4), 2), r"windows \(4, 4\) of .* do not belong to"),
    ],
)
def test_what_they_do_not_take(tiles, call, words):
    with pytest.raises(ValueError, match=words):
        call(_image(2, 4, 9, 9, dtype=th.float32), th.randn(5, 4, 4, 4))


def test_no_images(tiles):
    assert image_ops.gather(_image(0, 4, 9, 9, dtype=th.float32), th.randn(5, 4, 4, 4), 2, None, False).shape == (0, 5, 3, 3)
    narrow = _image(0, 5, 3, 3, dtype=th.float32)
    assert image_ops.scatter(narrow, th.randn(5, 4, 4, 4), 2, (8, 8), None, False).shape == (0, 4, 8, 8)
    assert not image_ops.weight_gradient(_image(0, 4, 9, 9, dtype=th.float32), narrow, (4, 4), 2).any()


# -- pixels and their loss -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("last", [False, True])
@pytest.mark.parametrize("shape", [(2, 5, 3, 16, 17), (1, 1, 3, 64, 64), (7, 1, 20, 16), (4, 3, 3, 5), (0, 3, 8, 8)], ids=str)
def test_bytes_become_numbers(kernels, threads, shape, last):
    """To the last bit, and laid out in the same way."""
    kind = Images(spaces.Box(0, 255, (3, 64, 64), np.uint8))
    raw = th.randint(0, 256, shape, dtype=th.uint8, generator=th.Generator().manual_seed(0))
    raw = raw.flatten(0, -4).contiguous(memory_format=th.channels_last).view(shape) if last else raw
    expected = kind.preprocess(raw)
    with native.using("native", "cpu"), Calls() as calls:
        found = kind.preprocess(raw)
        assert th.equal(kind.preprocess(raw.flip(-1)), expected.flip(-1))
        assert th.equal(kind.preprocess(raw.transpose(-1, -2)), expected.transpose(-1, -2))
    assert calls.counts["sb3_dreamer_urlb.scale_images.default"] == 3
    assert th.equal(found, expected) and found.dtype == th.float32
    assert found.flatten(0, -4).is_contiguous(memory_format=th.channels_last)


@pytest.mark.parametrize("dtype", ROUNDING)
@pytest.mark.parametrize("last", [False, True])
@pytest.mark.parametrize("shape", [(2, 5, 3, 16, 17), (3, 3, 64, 64), (1, 1, 3, 5)], ids=str)
def test_loss_of_images(kernels, threads, shape, last, dtype):
    format = th.channels_last if last else th.contiguous_format
    x, target = (_image(*shape[-4:], dtype=th.float32, seed=i).expand(shape).flatten(0, -4) for i in (3, 4))
    x, target = x.to(dtype).contiguous(memory_format=format), target.contiguous(memory_format=format)
    exact = x.double().requires_grad_()
    expected = distributions.image_nll(exact.view(shape), target.view(shape).double())
    leaf = x.clone(memory_format=th.preserve_format).requires_grad_()
    with native.using("native", "cpu"), Calls() as calls:
        loss = distributions.image_nll(leaf.view(shape), target.view(shape))
        (3 * loss).backward()
    assert calls.counts["sb3_dreamer_urlb.squared_distance.default"] == 1
    assert loss.dtype == th.float32 and loss.item() == pytest.approx(expected.item(), rel=1e-6)
    (slope,) = th.autograd.grad(3 * expected, exact)
    assert leaf.grad.stride() == x.stride() and (leaf.grad - slope).abs().max() <= 2 * ROUNDING[dtype] * slope.abs().max()


def test_a_loss_that_lies_otherwise_in_memory(kernels):
    mean, target = th.randn(4, 3, 5, 5), _image(4, 3, 5, 5, dtype=th.float32)
    with native.using("native", "cpu"):
        assert th.allclose(distributions.image_nll(mean, target), distributions.image_nll(mean, target.contiguous()))
        assert distributions.image_nll(mean[0], target[0]).isfinite()
        with pytest.raises(ValueError, match=r"the distance between .* is not computed"):
            pixel_ops.squared_distance(mean, target)
        with pytest.raises(TypeError, match=r"takes uint8, got torch\.float32"):
            pixel_ops.scale_images(mean, 255.0)
        with pytest.raises(ValueError, match="contiguous or channels last"):
            pixel_ops.scale_images(th.zeros(2, 3, 4, 5, dtype=th.uint8).transpose(0, 3), 255.0)


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_world_models_learn_the_same(kernels, learner, batch, precision):
    found = []
    for compile in ("eager", "native"):
        th.manual_seed(0)
        its = learner(None, compile=compile, precision=precision)
        with Calls() as calls:
            found.append([float(its.update(batch)["image_loss"]) for _ in range(3)])
        assert (calls.counts["sb3_dreamer_urlb.squared_distance.default"] == 3) == (compile == "native")
    assert found[0] == pytest.approx(found[1], rel=1e-5 if precision == "float32" else 1e-3)


def test_few_channels_in_float32_are_left_to_torch(tiles):
    x = th.randn(80, 16, 14, 14)
    for channels, ours in {convolution.CHANNELS - 1: False, convolution.CHANNELS: True}.items():
        layer = nn.Conv2d(16, channels, 4, 2)
        with native.using("native", "cpu"):
            assert convolution.convolves_on_tiles(layer, x) == ours
            with th.autocast("cpu"):
                assert convolution.convolves_on_tiles(layer, x)
