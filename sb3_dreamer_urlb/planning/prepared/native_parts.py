"""The parts of ``parts`` with kernels of our own (native/), which do in one pass what torch does in several."""

from __future__ import annotations

from typing import cast

import torch as th
from torch import nn

from sb3_dreamer_urlb.native import planner_ops, rollout_ops
from sb3_dreamer_urlb.native.planner_ops import rows_format, whole_lines
from sb3_dreamer_urlb.nn import distributions
from sb3_dreamer_urlb.nn.nets import MLP
from sb3_dreamer_urlb.nn.precision import multiply
from sb3_dreamer_urlb.planning.prepared.chain import Chain
from sb3_dreamer_urlb.planning.prepared.parts import SampledState, Visited
from sb3_dreamer_urlb.types import LatentState
from sb3_dreamer_urlb.world_model.rssm import RSSM


class NativeHead:
    """An MLP that reads sampled states.

    :param mlp: the network
    :param variables: S
    :param classes: K
    :param dtype: of products
    """

    def __init__(self, mlp: MLP, variables: int, classes: int, dtype: th.dtype):
        first, *others = (cast(nn.Linear, layer) for layer in [*mlp.dense, mlp.out])
        stoch_size = variables * classes
        rows_dtype = rows_format(dtype)
        self.rows = whole_lines(first.weight[:, :stoch_size].T, rows_dtype)
        self.bias = whole_lines(first.bias, rows_dtype)
        self.width = first.out_features
        weights = [first.weight[:, stoch_size:], *(layer.weight for layer in others)]
        self.layers = Chain(weights, [None, *(layer.bias for layer in others)], dtype)

    def __call__(self, classes: th.Tensor, rest: th.Tensor) -> th.Tensor:
        """Classes (n, S) and what else the first layer reads, (n, D) or with a skill (n, D + W) → float (n, outputs)."""
        part = rest.new_empty(len(rest), self.width)
        planner_ops.gather(self.rows, classes, None, None, self.bias, None, False, part)
        return self.layers(rest, part)


class NativeDynamics:
    """The RSSM's prior step.

    :param rssm: the network
    :param dtype: of products
    """

    def __init__(self, rssm: RSSM, dtype: th.dtype):
        self.dtype, self.shape, self.stoch_size = dtype, rssm.logits_shape, rssm.stoch_size
        self.hidden_size, self.deter_size = rssm.input.out_features, rssm.deter_size
        rows_dtype = rows_format(dtype)
        self.rows = whole_lines(rssm.input.weight[:, : rssm.stoch_size].T, rows_dtype)
        self.action_rows = whole_lines(rssm.input.weight[:, rssm.stoch_size :].T, rows_dtype)
        self.bias = whole_lines(rssm.input.bias, rows_dtype)
        self.gru, self.norm = Chain([rssm.gru.weight], [rssm.gru.bias], dtype), (rssm.gru_norm.weight, rssm.gru_norm.bias)
        self.epsilon = rssm.gru_norm.eps
        hidden, logits = rssm.prior_hidden, rssm.prior_logits
        self.logits = Chain([hidden.weight, logits.weight], [hidden.bias, logits.bias], dtype)
        self._start: LatentState | None = None

    def step(self, state: LatentState | SampledState, action: th.Tensor, generator: th.Generator | None) -> SampledState:
        before = addend = None
        if isinstance(state, LatentState):
            addend, inputs = self._start_part(state)
        else:
            assert state.inputs is not None
            before, inputs = state.classes, state.inputs
        planner_ops.gather(self.rows, before, self.action_rows, action, self.bias, addend, True, inputs[:, : self.hidden_size])
        next_inputs, short = self._inputs(inputs)
        deter = planner_ops.gates(self.gru(inputs, short=True), *self.norm, self.epsilon, state.deter, short)
        logits = self.logits(short, short=True).view(-1, *self.shape)
        classes = distributions.draw_classes_of_logits(logits, generator)
        return SampledState(classes, deter, short, self.stoch_size, next_inputs)

    def imagine(self, state: LatentState, action: th.Tensor, generator: th.Generator | None) -> Visited | None:
        """The states of many steps, in one pass and from the same random numbers as steps would use; None where the processor
        has no tiles.

        :param state: n starts
        :param action: float (n, H, A)
        :param generator: source of randomness, the global one if None
        """
        if not self.gru.laid:
            return None
        addend, _ = self._start_part(state)
        uniform = th.rand(action.shape[1], len(action), self.shape[0], generator=generator)
        layers = [self.rows, self.action_rows, self.bias, *self.gru.laid, *self.gru.biases, *self.norm]
        prior = [tensor for pair in zip(self.logits.laid, self.logits.biases, strict=True) for tensor in pair]
        start = state.deter.contiguous()
        classes, short = rollout_ops.rollout(start, addend, action.contiguous(), uniform, layers + prior, self.epsilon)
        return Visited(classes, short)

    def _start_part(self, state: LatentState) -> tuple[th.Tensor, th.Tensor]:
        """Computed once: each iteration of a plan begins with the same states."""
        if self._start is not state:
            rows = self.rows[:, : self.hidden_size].to(self.dtype)
            part = multiply(state.stoch.to(self.dtype), rows)
            inputs, short = self._inputs(state.deter)
            short.copy_(state.deter)
            self._start, self._parts = state, (part, inputs)
        return self._parts

    def _inputs(self, like: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Room for what the GRU reads, and the part of it that is the deterministic state."""
        inputs = like.new_empty(len(like), self.hidden_size + self.deter_size, dtype=self.dtype)
        return inputs, inputs[:, self.hidden_size :]
