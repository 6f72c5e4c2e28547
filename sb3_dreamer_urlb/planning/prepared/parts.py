"""An agent's networks in the form that plans on a CPU: what they read is sampled states, not features.

A sampled state is S ones among S · K numbers. A product with it is the sum of S rows of the weights, so states keep the ones'
places and no layer ever reads the other numbers. Weights are brought into the products' format once a plan.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import torch as th
import torch.nn.functional as F
from torch import nn

from sb3_dreamer_urlb.nn import distributions
from sb3_dreamer_urlb.nn.activation import elu_
from sb3_dreamer_urlb.nn.nets import MLP
from sb3_dreamer_urlb.nn.precision import full, multiply
from sb3_dreamer_urlb.planning.prepared.prepacked import PrepackedLinear
from sb3_dreamer_urlb.types import LatentState
from sb3_dreamer_urlb.world_model.rssm import RSSM

#: of a logit above its variable's mean, so that exp stays finite; another class this far above would be drawn as often
MAX_LOGIT = 80.0
#: variables drawn at once: what a processor's cache holds
BLOCK = 8


@dataclass
class SampledState:
    """z as the places of its ones.

    :param classes: int64 (n, S), counted through all S · K numbers
    :param deter: float (n, D)
    :param short: ``deter`` in the format of products
    :param stoch_size: S · K
    :param inputs: what the GRU will read, (n, hidden + D), ``short`` behind room for the rest; only of kernels of our own
    """

    classes: th.Tensor
    deter: th.Tensor
    short: th.Tensor
    stoch_size: int
    inputs: th.Tensor | None = None

    @property
    def feature(self) -> th.Tensor:
        """[stochastic, deterministic], float (n, F)."""
        stoch = self.deter.new_zeros(len(self.deter), self.stoch_size).scatter_(1, self.classes, 1.0)
        return th.cat([stoch, self.deter], -1)


@dataclass
class Visited:
    """What the heads read of T successive states; slices are successive states, too.

    :param classes: int64 (T, n, S)
    :param short: (T, n, D)
    """

    classes: th.Tensor
    short: th.Tensor

    def __getitem__(self, which: slice) -> Visited:
        return Visited(self.classes[which], self.short[which])


class Head:
    """An MLP that reads sampled states.

    :param mlp: the network
    :param variables: S
    :param classes: K
    :param dtype: of products
    """

    def __init__(self, mlp: MLP, variables: int, classes: int, dtype: th.dtype):
        first, *others = (cast(nn.Linear, layer) for layer in [*mlp.dense, mlp.out])
        stoch_size = variables * classes
        # Each state is the sum of S rows: an S-th of the bias in each.
        self.rows = (first.weight[:, :stoch_size].T + first.bias / variables).to(dtype).contiguous()
        self.rest = PrepackedLinear(first.weight[:, stoch_size:], None, dtype)
        self.layers = [PrepackedLinear(layer.weight, layer.bias, dtype) for layer in others]

    def __call__(self, classes: th.Tensor, rest: th.Tensor) -> th.Tensor:
        """Classes (n, S) and what else the first layer reads, (n, D) or with a skill (n, D + W) → float (n, outputs)."""
        x = self.rest(rest, plus=F.embedding_bag(classes, self.rows, mode="sum"))
        for layer in self.layers:
            x = layer(elu_(x))
        return full(x)


class Dynamics:
    """The RSSM's prior step.

    :param rssm: the network
    :param dtype: of products
    """

    def __init__(self, rssm: RSSM, dtype: th.dtype):
        self.dtype, self.shape, self.stoch_size = dtype, rssm.logits_shape, rssm.stoch_size
        self.rows = rssm.stoch_rows().to(dtype)
        self.action = PrepackedLinear(rssm.input.weight[:, rssm.stoch_size :], rssm.input.bias, dtype)
        self.gru, self.norm = _in_order_of_use(rssm, dtype)
        self.hidden = PrepackedLinear(rssm.prior_hidden.weight, rssm.prior_hidden.bias, dtype)
        # A constant for each variable changes no probability: logits whose mean is 0 need no search for their largest.
        weight = rssm.prior_logits.weight.view(*self.shape, -1)
        bias = rssm.prior_logits.bias.view(self.shape)
        self.logits_weight = (weight - weight.mean(1, keepdim=True)).flatten(0, 1).to(dtype)
        self.logits_bias = (bias - bias.mean(1, keepdim=True)).unsqueeze(-1)
        self.first_class = th.arange(0, rssm.stoch_size, self.shape[1])
        self._start: LatentState | None = None

    def step(self, state: LatentState | SampledState, action: th.Tensor, generator: th.Generator | None) -> SampledState:
        if isinstance(state, LatentState):
            stoch_part, short = self._start_part(state), state.deter.to(self.dtype)
        else:
            stoch_part, short = F.embedding_bag(state.classes, self.rows, mode="sum"), state.short
        x = elu_(self.action(action.to(self.dtype), plus=stoch_part))
        deter = self._recur(th.cat([x, short], -1), state.deter)
        short = deter.to(self.dtype)
        return SampledState(self._draw(short, generator), deter, short, self.stoch_size)

    def _start_part(self, state: LatentState) -> th.Tensor:
        """Computed once: each iteration of a plan begins with the same states."""
        if self._start is not state:
            self._start, self._part = state, multiply(state.stoch.to(self.dtype), self.rows)
        return self._part

    def _recur(self, inputs: th.Tensor, deter: th.Tensor) -> th.Tensor:
        parts = F.layer_norm(full(self.gru(inputs)), self.norm[0].shape, *self.norm)
        size = deter.shape[-1]
        reset, update = parts[:, : 2 * size].sigmoid().chunk(2, -1)
        return th.lerp(deter, reset.mul(parts[:, 2 * size :]).tanh_(), update)

    def _draw(self, short: th.Tensor, generator: th.Generator | None) -> th.Tensor:
        """Classes lie outermost in memory: what is done for each class runs over all states at once."""
        hidden = elu_(self.hidden(short)).T
        logits = multiply(self.logits_weight, hidden).view(*self.shape, -1)  # (S, K, n)
        drawn = []
        for block, bias in zip(logits.split(BLOCK), self.logits_bias.split(BLOCK), strict=True):
            probs = block.float().add_(bias).clamp_(max=MAX_LOGIT).exp_().movedim(-1, 0)
            drawn.append(distributions.draw_classes(probs, generator))
        return th.cat(drawn, 1).add_(self.first_class)


def _in_order_of_use(rssm: RSSM, dtype: th.dtype) -> tuple[PrepackedLinear, tuple[th.Tensor, th.Tensor]]:
    """The GRU's layer and its norm with the parts (reset, update, candidate), and the bias of the update gate within."""

    def ordered(parameter: th.Tensor) -> th.Tensor:
        reset, candidate, update = parameter.chunk(3)
        return th.cat([reset, update, candidate])

    norm_bias = ordered(rssm.gru_norm.bias)
    norm_bias[rssm.deter_size : 2 * rssm.deter_size] -= 1
    gru = PrepackedLinear(ordered(rssm.gru.weight), ordered(rssm.gru.bias), dtype)
    return gru, (ordered(rssm.gru_norm.weight), norm_bias)
