"""Updates whose loss or gradient is not finite: skipped, counted, and the end of a run where they do not stop.

The optimisers decide on the device whether they step (:class:`~sb3_dreamer_urlb.learning.optim.ClippedAdam`); here are the
counts, and the statistics that a bad batch must not spoil either. Only :meth:`UpdateGuard.repeated` and
:meth:`UpdateGuard.total` wait for the device.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

import torch as th
from torch import nn

from sb3_dreamer_urlb.learning.optim import ClippedAdam

#: the parts that learn from rewards, or give them
BEHAVIOR = {"actor", "critic", "intrinsic"}
#: skipped updates in a row that end a run; looked at every so many updates
MAX_IN_A_ROW = 20


class NumericalFaultError(ValueError):
    """Losses or gradients stayed non-finite. A ValueError, on which rl_zoo3's ``-optimize`` prunes the trial."""


class UpdateGuard:
    """Counts the updates that were skipped, and keeps running statistics finite.

    :param optimizers: of an agent's parts, by name
    :param statistics: modules whose buffers of numbers an update changes without an optimiser
    """

    def __init__(self, optimizers: dict[str, ClippedAdam], statistics: Iterable[nn.Module] = ()):
        self.optimizers = optimizers
        self.statistics = tuple(statistics)
        device = next(iter(optimizers.values())).parameters[0].device
        #: which parts' steps the last update skipped, in the order of ``optimizers``
        self.skipped = th.zeros(len(optimizers), dtype=th.bool, device=device)
        self._good = th.zeros((), dtype=th.bool, device=device)
        self._in_a_row = th.zeros((), dtype=th.int64, device=device)
        self._total = th.zeros((), dtype=th.int64, device=device)
        self._since_check = 0

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Around an update."""
        for optimizer in self.optimizers.values():
            optimizer.skipped = None
        statistics = self._statistics()
        before = [value.clone() for value in statistics]
        yield
        if statistics:
            # All or none: a mean must not stay behind its count.
            finite = th.stack([value.isfinite().all() for value in statistics]).all()
            for value, old in zip(statistics, before, strict=True):
                value.copy_(th.where(finite, value, old))
        # A part that had nothing to learn skipped nothing.
        flags = [self._good if o.skipped is None else o.skipped for o in self.optimizers.values()]
        self.skipped.copy_(th.stack(flags))
        bad = self.skipped.any()
        # In place: a recorded update (graphs.py) counts on.
        self._in_a_row.add_(1).mul_(bad)
        self._total.add_(bad)

    def count(self) -> None:
        """After an update, recorded or not."""
        self._since_check += 1

    def memory(self) -> tuple[th.Tensor, ...]:
        """All tensors that :meth:`watching` reads and writes, besides the statistics."""
        return self.skipped, self._good, self._in_a_row, self._total

    def _statistics(self) -> list[th.Tensor]:
        """What updates change without an optimiser."""
        return [value for module in self.statistics for value in module.buffers() if value.is_floating_point()]

    def repeated(self) -> list[str]:
        """The parts that kept the last ``MAX_IN_A_ROW`` updates from being learnt; looks only every so many updates."""
        if self._since_check < MAX_IN_A_ROW:
            return []
        self._since_check = 0
        if int(self._in_a_row) < MAX_IN_A_ROW:
            return []
        return [name for name, skipped in zip(self.optimizers, self.skipped.tolist(), strict=True) if skipped]

    def total(self) -> int:
        """Skipped updates so far."""
        return int(self._total)

    def stop_if_repeated(self, step: int, rewarded_by: str) -> None:
        """End a run that no longer learns: its weights are those of the last good update, and ``learn`` saves them.

        :param step: for the message
        :param rewarded_by: what the behaviour learns from, likewise; it begins a sentence
        :raises NumericalFaultError: after ``MAX_IN_A_ROW`` skipped updates in a row, naming the parts
        """
        parts = [name.removesuffix("_optimizer") for name in self.repeated()]
        if not parts:
            return
        # The world model is none of them: its numbers are good, and so what they are paid with may be bad.
        paid = f" {rewarded_by} may be what is not." if set(parts) <= BEHAVIOR else ""
        raise NumericalFaultError(
            f"At step {step}, {MAX_IN_A_ROW} or more updates in a row were skipped: the loss or the gradient of "
            f"the {' and the '.join(parts)} was not finite.{paid} Smaller learning rates may "
            "help, and rewards of the order of one."
        )
