"""What every learner is: optimisers, a guard against numbers that are not finite, and an update that can be recorded."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Hashable, Iterable, Iterator
from typing import Any, Generic, TypeVar

import torch as th
from torch import nn

from sb3_dreamer_urlb import native
from sb3_dreamer_urlb.intrinsic.method import check_learnt
from sb3_dreamer_urlb.learning.graphs import Recorder, make_backend, memory_of
from sb3_dreamer_urlb.learning.memory import keep_freed_memory
from sb3_dreamer_urlb.learning.numerical_faults import UpdateGuard
from sb3_dreamer_urlb.learning.optim import ClippedAdam
from sb3_dreamer_urlb.nn import precision as precisions
from sb3_dreamer_urlb.types import Metrics

AnyAgent = TypeVar("AnyAgent", bound=nn.Module)
Batch = TypeVar("Batch")


class BaseLearner(Generic[AnyAgent, Batch]):
    """Trains an agent, batch by batch.

    Nothing in an update asks the device for a value: metrics stay tensors until somebody logs them. A CUDA graph can hold
    all of :meth:`_update_all` (graphs.py); what happens only now and then, or in Python, stands in :meth:`_after_update`.

    A subclass makes its optimisers, then calls :meth:`_get_ready`.

    :param agent: the networks
    :param compile: how updates run, one of ``graphs.COMPILE``
    :param precision: of the products in the forward and backward passes, see there; all else is float32
    :param width: of the layers that most products are of, for ``precision="auto"``
    """

    #: what an update does on the device, recorded if that is wanted and possible
    recorder: Recorder[Metrics]
    guard: UpdateGuard
    #: the numbers of an update
    config: Any

    def __init__(self, agent: AnyAgent, compile: str, precision: str, width: int):
        self.agent = agent
        if self.device.type == "cpu":
            keep_freed_memory()
        self._compile = compile
        #: format of the products
        self.dtype = precisions.choose(precision, "update", self.device, width)
        self.updates = 0

    def _get_ready(self, statistics: Iterable[nn.Module], recorded: nn.Module | None) -> None:
        """
        :param statistics: modules whose buffers of numbers an update changes without an optimiser
        :param recorded: what may say, with ``graph_safe = False``, that an update cannot be recorded
        """
        self.guard = UpdateGuard(self.optimizers(), statistics)
        self._recorded = recorded
        self._record_anew(recorded)

    def configure(self, config: Any) -> None:
        """Take other numbers from the next update on; step sizes are set apart, for they follow schedules.

        :param config: of the learner's kind; differs in numbers only
        """
        self.config = config
        for optimizer in self.optimizers().values():
            optimizer.eps, optimizer.max_grad_norm = config.adam_eps, config.max_grad_norm
            optimizer.weight_decay = config.weight_decay
        # A recording holds the old ones.
        self._record_anew(self._recorded)

    def _record_anew(self, recorded: nn.Module | None) -> None:
        """Forget recordings of updates.

        :param recorded: see :meth:`_get_ready`
        """
        self.recorder = Recorder(self._update, make_backend(self._compile, self.device), self._memory, "The update")
        if not getattr(recorded, "graph_safe", True):
            self.recorder.give_up(f"{type(recorded).__name__}.graph_safe is False")

    @property
    def device(self) -> th.device:
        """Where the agent is."""
        return next(self.agent.parameters()).device

    def _products(self) -> th.autocast:
        """Around every forward pass, and around nothing else: a step on a loss needs no autocast."""
        return precisions.products(self.device, self.dtype)

    @abstractmethod
    def optimizers(self) -> dict[str, ClippedAdam]:
        """All optimisers by name; the names are those of snapshots."""

    def update(self, batch: Batch) -> Metrics:
        """Learn from one batch; parts whose loss or gradient is not finite do not.

        :param batch: on the agent's device
        :return: metrics, detached scalars on the device
        """
        with native.using(self._compile, self.device):
            metrics = self.recorder(batch, situation=self._situation())
        self.guard.count()
        self._after_update()
        self.updates += 1
        return metrics

    @abstractmethod
    def _update_all(self, batch: Batch) -> Metrics:
        """One step of every part."""

    def _after_update(self) -> None:
        """What is not part of every update."""

    def _situation(self) -> tuple[Hashable, ...]:
        """What decides on the host which way an update goes."""
        return ()

    def _memory(self) -> Iterator[th.Tensor]:
        """What an update reads and writes besides the batch."""
        yield from memory_of(self.agent)
        yield from self.guard.memory()
        for optimizer in self.optimizers().values():
            yield from optimizer.memory()

    @staticmethod
    def _step_intrinsic(method: nn.Module, learnt: tuple[th.Tensor, Metrics] | None, optimizer: ClippedAdam | None) -> Metrics:
        """What an intrinsic reward's networks learn; nothing where there is nothing to learn.

        :param method: the intrinsic reward
        :param learnt: its loss and metrics
        :param optimizer: its own; None if there is nothing to train
        :raises ValueError: for what is no loss
        """
        check_learnt(method, learnt)
        if learnt is None:
            return {}
        loss, metrics = learnt
        metrics = {f"intrinsic_{name}": value.detach() for name, value in metrics.items()}
        metrics["intrinsic_loss"] = loss.detach()
        if optimizer is not None:
            if not loss.requires_grad:
                raise ValueError(f"{type(method).__qualname__}.loss depends on nothing that it could train.")
            metrics["intrinsic_grad_norm"] = optimizer.step(loss, partly=True)
        return metrics

    def _update(self, batch: Any, generator: th.Generator | None = None, *situation: Hashable) -> Metrics:
        with self.guard.watching():
            return self._update_all(batch)
