"""Random draws and the three densities of the agent: one-hot categorical, bounded normal, unit-variance normal.

Every draw of the whole agent goes through ``draw_classes``, ``draw_classes_of_logits``, ``draw_classes_and_probs`` and
``draw_normal``, called through this module, so a test can make the agent deterministic by replacing those four functions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch as th
import torch.nn.functional as F
from torch.autograd import Function
from torch.autograd.function import FunctionCtx, once_differentiable

from sb3_dreamer_urlb import native
from sb3_dreamer_urlb.native import pixel_ops, planner_ops
from sb3_dreamer_urlb.nn.precision import full

HALF_LOG_2PI = 0.5 * math.log(2 * math.pi)
ACTION_MARGIN = 1e-6
#: logits from which on kernels of our own pay
NATIVE_SIZE = 2**14


def draw_classes(probs: th.Tensor, generator: th.Generator | None = None) -> th.Tensor:
    """Draw one class per categorical by inverting its cumulative distribution.

    One uniform number per variable instead of one Gumbel number per class.

    :param probs: non-negative weights, (…, K); they need not sum to one
    :param generator: source of randomness, the global one if None
    :return: class indices, int64 (…)
    """
    if probs.device.type == "cpu" and probs.dim() > 1 and len(probs) > 1 and probs.movedim(0, -1).is_contiguous():
        return _draw_by_counting(probs, generator)
    cdf = probs.cumsum(-1)
    uniform = th.rand(cdf.shape[:-1] + (1,), generator=generator, device=cdf.device, dtype=cdf.dtype)
    # Rounding can make the product the whole sum, hence the bound.
    return th.searchsorted(cdf, uniform * cdf[..., -1:], right=True).squeeze(-1).clamp_(max=cdf.shape[-1] - 1)


def _draw_by_counting(probs: th.Tensor, generator: th.Generator | None) -> th.Tensor:
    """:func:`draw_classes` where the first dimension is innermost in memory: operations take one class of all rows at once."""
    weights = probs.movedim(0, -1).unbind(-2)  # K of (…, n)
    cdf = th.empty_like(probs.movedim(0, -1))
    first, *others = by_class = cdf.unbind(-2)
    first.copy_(weights[0])
    for below, weight, this in zip(by_class, weights[1:], others, strict=False):
        th.add(below, weight, out=this)
    bound = th.empty_like(by_class[-1]).uniform_(generator=generator).mul_(by_class[-1])
    # In place a comparison gives numbers, which are faster to count than booleans.
    return cdf.le_(bound.unsqueeze(-2)).sum(-2).clamp_(max=len(by_class) - 1).movedim(-1, 0).long()


def draw_classes_of_logits(logits: th.Tensor, generator: th.Generator | None = None) -> th.Tensor:
    """Draw one class per categorical with a kernel of our own, only inside ``native.using()``.

    :param logits: float32 or bfloat16 (…, S, K), contiguous
    :param generator: source of randomness, the global one if None
    :return: class indices, counted through all S · K, int64 (…, S)
    """
    uniform = th.rand(logits.shape[:-1], generator=generator)
    classes: th.Tensor = planner_ops.draws(logits, None, uniform, True, False)[0]
    return classes


def draw_classes_and_probs(logits: th.Tensor, generator: th.Generator | None = None) -> tuple[th.Tensor, th.Tensor]:
    """Draw one class per categorical with a kernel of our own, only inside ``native.using()``.

    :param logits: float32 or bfloat16 (…, S, K), contiguous
    :param generator: source of randomness, the global one if None
    :return: class indices of each categorical, int64 (…, S), and probabilities, float32 (…, S, K)
    """
    uniform = th.rand(logits.shape[:-1], generator=generator)
    classes, probs = planner_ops.draws(logits, None, uniform, False, True)
    return classes, probs


def draw_normal(shape: th.Size | tuple[int, ...], like: th.Tensor, generator: th.Generator | None = None) -> th.Tensor:
    """Standard normal noise.

    :param shape: of the noise
    :param like: a tensor whose device and dtype the noise takes
    :param generator: source of randomness, the global one if None
    """
    return th.randn(shape, generator=generator, device=like.device, dtype=like.dtype)


def sample_one_hot(logits: th.Tensor, generator: th.Generator | None = None) -> th.Tensor:
    """Draw one-hot vectors with straight-through gradients: forward the draw, backward the probabilities.

    :param logits: (…, S, K); float32, or the short format of products
    :param generator: source of randomness
    :return: one-hot (…, S, K), in the format of the logits
    """
    if native.on_lanes() and logits.device.type == "cpu" and logits.numel() >= NATIVE_SIZE:
        drawn: th.Tensor = _Sample.apply(logits.contiguous(), generator)  # type: ignore[no-untyped-call]
        return drawn
    probs = full(logits).softmax(-1)
    one_hot = one_hot_like(probs, draw_classes(probs.detach(), generator)).to(logits.dtype)
    if not probs.requires_grad:
        return one_hot
    sample: th.Tensor = _StraightThrough.apply(one_hot, probs)  # type: ignore[no-untyped-call]
    return sample


class _Sample(Function):
    """A one-hot draw from logits, with the gradient of their probabilities, by kernels of our own."""

    @staticmethod
    def forward(ctx: FunctionCtx, logits: th.Tensor, generator: th.Generator | None) -> th.Tensor:
        classes, probs = draw_classes_and_probs(logits, generator)
        ctx.save_for_backward(probs)
        drawn: th.Tensor = planner_ops.one_hot(classes, logits)
        return drawn

    @staticmethod
    @once_differentiable
    def backward(ctx: FunctionCtx, grad: th.Tensor) -> tuple[th.Tensor, None]:
        (probs,) = ctx.saved_tensors  # type: ignore[attr-defined]
        return planner_ops.softmax_backward(grad.contiguous(), probs), None


class _StraightThrough(Function):
    """The first argument, with the gradient of the second."""

    @staticmethod
    def forward(ctx: FunctionCtx, value: th.Tensor, slope: th.Tensor) -> th.Tensor:
        return value.view_as(value)

    @staticmethod
    def backward(ctx: FunctionCtx, grad: th.Tensor) -> tuple[None, th.Tensor]:
        return None, full(grad)


def one_hot_like(probs: th.Tensor, classes: th.Tensor) -> th.Tensor:
    """Class indices (…) as one-hot vectors of the shape and format of ``probs``, (…, K)."""
    return th.zeros_like(probs).scatter_(-1, classes.unsqueeze(-1), 1.0)


def categorical_kl(logits_p: th.Tensor, logits_q: th.Tensor) -> th.Tensor:
    """KL(p ‖ q) in nats, summed over the S variables: (…, S, K) → (…)."""
    log_p, log_q = logits_p.log_softmax(-1), logits_q.log_softmax(-1)
    return (log_p.exp() * (log_p - log_q)).sum((-1, -2))


def categorical_entropy(logits: th.Tensor) -> th.Tensor:
    """Entropy in nats, summed over the S variables: (…, S, K) → (…)."""
    log_p = logits.log_softmax(-1)
    return -(log_p.exp() * log_p).sum((-1, -2))


def unit_normal_nll(mean: th.Tensor, target: th.Tensor) -> th.Tensor:
    """Negative log-likelihood of ``target`` under a normal of unit variance, constant included, elementwise."""
    return 0.5 * (mean - target).square() + HALF_LOG_2PI


def image_nll(mean: th.Tensor, target: th.Tensor) -> th.Tensor:
    """:func:`unit_normal_nll` summed over pixels and channels, averaged over the images.

    :param mean: float (…, C, height, width), bfloat16 where kernels of our own compute it
    :param target: same shape
    :return: scalar
    """
    pixels = mean.shape[-3:].numel()
    images = mean.numel() // pixels
    # Four dimensions can be told to have their channels last in memory.
    if mean.dim() > 3:
        mean, target = mean.flatten(0, -4), target.flatten(0, -4)
    distance: th.Tensor = _SquaredDistance.apply(mean, target)  # type: ignore[no-untyped-call]
    return distance / (2 * images) + pixels * HALF_LOG_2PI


class _SquaredDistance(Function):
    """Of all images together. torch's own loss hands its gradient on in another memory layout than the images have."""

    @staticmethod
    def forward(ctx: FunctionCtx, mean: th.Tensor, target: th.Tensor) -> th.Tensor:
        if native.active() and pixel_ops.comparable(mean, target):
            ours, difference = pixel_ops.squared_distance(mean, target)
            ctx.save_for_backward(difference)
            return ours  # type: ignore[no-any-return]
        difference = mean - target
        ctx.save_for_backward(difference)
        distance: th.Tensor = th.linalg.vector_norm(difference, dim=(-3, -2, -1))
        return distance.square().sum()

    @staticmethod
    @once_differentiable
    def backward(ctx: FunctionCtx, grad: th.Tensor) -> tuple[th.Tensor, None]:
        (difference,) = ctx.saved_tensors  # type: ignore[attr-defined]
        return difference * (2 * grad), None


class BoundedNormal:
    """The actor's distribution: a normal whose samples are clamped to the action box.

    Entropy and log-probability are those of the *untruncated* normal, as in the authors' code (docs/algorithm.md,
    "Behaviour").

    :param mean: in (-1, 1), float (…, A)
    :param std: positive, float (…, A)
    """

    def __init__(self, mean: th.Tensor, std: th.Tensor):
        self.mean = mean
        self.std = std

    @property
    def mode(self) -> th.Tensor:
        """The most likely action, float (…, A)."""
        return self.mean

    def sample(self, generator: th.Generator | None = None, noise_clip: float | None = None) -> th.Tensor:
        """A reparametrised sample clamped to ±(1 − 1e-6); the clamp passes gradients straight through.

        :param generator: source of randomness
        :param noise_clip: bound of the distance from the mean, None for none
        """
        noise = self.std * draw_normal(self.mean.shape, self.mean, generator)
        sample = self.mean + (noise if noise_clip is None else noise.clamp(-noise_clip, noise_clip))
        clamped = sample.detach().clamp(-1 + ACTION_MARGIN, 1 - ACTION_MARGIN)
        return sample + (clamped - sample.detach()) if sample.requires_grad else clamped

    def entropy(self) -> th.Tensor:
        """In nats, summed over the action's dimensions: (…)."""
        return (self.std.log() + 0.5 + HALF_LOG_2PI).sum(-1)

    def log_prob(self, action: th.Tensor) -> th.Tensor:
        """Log-density of ``action``, summed over its dimensions: (…)."""
        return -(0.5 * ((action - self.mean) / self.std).square() + self.std.log() + HALF_LOG_2PI).sum(-1)


class OneHotChoices:
    """The actor's distribution over independent choices among classes, as one-hot vectors one after the other.

    :param logits: of all classes of all choices, float (…, A)
    :param classes: number of classes of each choice; they sum to A
    """

    def __init__(self, logits: th.Tensor, classes: Sequence[int]):
        self.classes = tuple(classes)
        self.logits = logits.split(self.classes, -1)

    @property
    def mode(self) -> th.Tensor:
        """The most likely action, one-hot (…, A)."""
        return th.cat([one_hot_like(part, part.argmax(-1)) for part in self.logits], -1)

    def sample(self, generator: th.Generator | None = None) -> th.Tensor:
        """One-hot choices with straight-through gradients, (…, A)."""
        return th.cat([sample_one_hot(part, generator) for part in self.logits], -1)

    def entropy(self) -> th.Tensor:
        """In nats, summed over the choices: (…)."""
        return th.stack([categorical_entropy(part.unsqueeze(-2)) for part in self.logits]).sum(0)

    def log_prob(self, action: th.Tensor) -> th.Tensor:
        """Log-probability of one-hot choices, (…, A) → (…)."""
        log_p = th.cat([part.log_softmax(-1) for part in self.logits], -1)
        return (log_p * action).sum(-1)


def one_hot_choices(probs: th.Tensor, classes: Sequence[int], generator: th.Generator | None = None) -> th.Tensor:
    """Draw one-hot vectors, one for each choice.

    :param probs: of all classes of all choices, (…, A)
    :param classes: number of classes of each choice; they sum to A
    :param generator: source of randomness
    """
    parts = probs.split(tuple(classes), -1)
    return th.cat([one_hot_like(part, draw_classes(part, generator)) for part in parts], -1)


def bernoulli_nll(logit: th.Tensor, target: th.Tensor) -> th.Tensor:
    """Negative log-likelihood of a Bernoulli variable, elementwise.

    :param logit: log-odds
    :param target: probability of one, same shape
    """
    return F.binary_cross_entropy_with_logits(logit, target, reduction="none")
