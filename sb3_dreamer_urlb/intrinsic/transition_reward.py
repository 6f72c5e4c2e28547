"""Rewards that an agent without a world model makes for itself, from encoded steps of its replay."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import torch as th

from sb3_dreamer_urlb.intrinsic.method import ExplorationMethod
from sb3_dreamer_urlb.types import Metrics


@dataclass(frozen=True)
class EncoderSizes:
    """Sizes that a method's networks need to know.

    :param encoding: E, of the encoder's output
    :param action: A
    :param hidden: width of the agent's hidden layers
    """

    encoding: int
    action: int
    hidden: int


@dataclass
class EncodedSteps:
    """B steps of the replay as the encoder sees them.

    :param encoding: where each began, float (B, E)
    :param action: what was done there, in [-1, 1], float (B, A)
    :param next_encoding: where its n-step return ends, float (B, E), without a gradient
    """

    encoding: th.Tensor
    action: th.Tensor
    next_encoding: th.Tensor


class TransitionReward(ExplorationMethod, ABC):
    """A reward for replayed steps, in place of the task's while an agent without a world model pre-trains.

    A subclass takes its hyperparameters in ``__init__``, makes its networks in :meth:`build`, and says in :meth:`loss` what
    they learn and in :meth:`reward` what a step is worth. Parameters and buffers are what snapshots hold.
    """

    reads: ClassVar[str] = "encoded steps"

    def __init__(self) -> None:
        super().__init__()
        #: True: the gradient of :meth:`loss` trains the encoder, on whose encodings, detached, actor and critic learn.
        #: False, or without a :meth:`loss` that reaches it: the encoder learns from the critic's loss, as on a task
        self.trains_encoder = True

    def takes_encoder_over(self) -> bool:
        """Whether :meth:`loss` may train the encoder in place of the critic's."""
        return self.trains_encoder and type(self).loss is not TransitionReward.loss

    def build(self, sizes: EncoderSizes) -> None:
        """Make the networks. Called once, on a copy of what the user handed in.

        :param sizes: of the agent
        """

    def loss(self, steps: EncodedSteps) -> tuple[th.Tensor, Metrics] | None:
        """What the networks learn from a batch; None if there is nothing to learn.

        Where it depends on ``steps.encoding``, its gradient trains the encoder, also without networks of its own.

        :param steps: their ``encoding`` carries a gradient if ``trains_encoder``
        :return: loss (scalar) and metrics (detached scalars, logged as ``train/intrinsic_<name>``)
        """
        return None

    @abstractmethod
    def reward(self, steps: EncodedSteps) -> th.Tensor:
        """What each step is worth, float (B,). Called after the step on :meth:`loss`, without gradients.

        :param steps: detached
        """
