"""The optimiser of every part: clip the global norm, shrink every weight, Adam step (docs/algorithm.md, "Optimiser")."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import torch as th
from torch import nn

from sb3_dreamer_urlb.before_opengl import load_triton

# Not only when the first optimiser is made: a user's environment may draw before.
load_triton()


class ClippedAdam:
    """Adam with a global gradient-norm bound and a weight decay that does not scale with the learning rate.

    :param parameters: what it trains
    :param learning_rate: step size
    :param eps: Adam's ε
    :param max_grad_norm: bound of the gradient's global norm
    :param weight_decay: every parameter is multiplied by (1 − weight_decay) in each step
    """

    def __init__(
        self, parameters: Iterable[nn.Parameter], learning_rate: float, eps: float, max_grad_norm: float, weight_decay: float
    ):
        self.parameters = list(parameters)
        device = self.parameters[0].device if self.parameters else th.device("cpu")
        self.learning_rate = learning_rate
        # On the device, so that a recorded step (graphs.py) follows a schedule, too.
        self._rate = th.full((), learning_rate, device=device)
        self.eps = eps
        self.max_grad_norm = max_grad_norm
        self.weight_decay = weight_decay
        #: whether a step was skipped, bool scalar on the device, since whoever wants to know set it to None
        self.skipped: th.Tensor | None = None
        #: the parameters that the last step's loss depended on
        self.reached: list[nn.Parameter] = []
        self._capturable = device.type == "cuda"
        self.adam = th.optim.Adam(self.parameters, lr=self._rate, eps=eps, fused=True, capturable=self._capturable)
        # torch would warn that a capturable optimiser is wasted on steps outside of a graph, which the first ones are.
        self.adam._warned_capturable_if_run_uncaptured = True

    def set_learning_rate(self, learning_rate: float) -> None:
        """Change the step size; the weight decay stays what it is (a step size of 0 stops both)."""
        if learning_rate != self.learning_rate:
            self.learning_rate = learning_rate
            self._rate.fill_(learning_rate)

    def step(self, loss: th.Tensor, partly: bool = False, again: bool = False) -> th.Tensor:
        """Descend ``loss``; other parameters in its graph receive no gradient.

        A loss or gradient that is not finite changes nothing, neither weights nor moments. That is decided on the device.

        :param loss: scalar
        :param partly: it may depend on some of the parameters only; the others, and their moments, stay as they are
        :param again: keep its graph, for another optimiser's step on it
        :return: the gradient's global norm before the bound, a detached scalar
        """
        grads = th.autograd.grad(loss, self.parameters, retain_graph=again, allow_unused=partly)
        for parameter, grad in zip(self.parameters, grads, strict=True):
            # Fused Adam reads raw memory: a gradient laid out channels-last would be applied to the wrong weights.
            parameter.grad = None if grad is None else grad.contiguous()
        self.reached = [parameter for parameter in self.parameters if parameter.grad is not None]
        if not self.reached:
            return loss.detach().new_zeros(())
        norm = nn.utils.clip_grad_norm_(self.parameters, self.max_grad_norm)
        skips = ~(norm.isfinite() & loss.detach().isfinite())
        self.skipped = skips if self.skipped is None else self.skipped | skips
        self._shrink(~skips & (self._rate > 0))
        for group in self.adam.param_groups:
            # Whoever loads Adam's state replaces its settings, too.
            group.update(lr=self._rate, eps=self.eps, weight_decay=0.0, capturable=self._capturable)
        # What torch's gradient scaler tells fused Adam by.
        self.adam.found_inf = skips.float()  # type: ignore[attr-defined]
        self.adam.step()
        self.adam.zero_grad(set_to_none=True)
        if len(self.adam.state) < len(self.parameters):
            self._begin_moments()
        return norm

    def _begin_moments(self) -> None:
        """Of parameters that no loss has reached yet: files hold those of all, or of none."""
        for parameter in self.parameters:
            if parameter not in self.adam.state:
                self.adam.state[parameter] = {
                    "step": th.zeros((), device=parameter.device),
                    "exp_avg": th.zeros_like(parameter, memory_format=th.preserve_format),
                    "exp_avg_sq": th.zeros_like(parameter, memory_format=th.preserve_format),
                }

    @th.no_grad()
    def _shrink(self, steps: th.Tensor) -> None:
        """The weight decay, where ``steps``, a bool scalar on the device, is true."""
        th._foreach_mul_(tuple(self.reached), 1 - self.weight_decay * steps.to(self._rate.dtype))

    def memory(self) -> Iterator[th.Tensor]:
        """All that a step reads and writes besides the parameters and the loss: moments and the step size."""
        yield self._rate
        for state in self.adam.state.values():
            yield from state.values()

    def state_dict(self) -> dict[str, Any]:
        """Adam's moments and settings."""
        return self.adam.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what :meth:`state_dict` gave."""
        self.adam.load_state_dict(state)
