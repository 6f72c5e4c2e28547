"""One update of DrQ-v2 on one batch: intrinsic reward, critic with the encoder, actor, target.

DDPG with n-step returns, two critics and random shifts (Yarats et al., 2021); pre-training as in the benchmark (URLB,
Laskin et al., 2021).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import torch as th
from stable_baselines3.common.utils import polyak_update
from torch import nn

from sb3_dreamer_urlb.drq_v2.agent import DrQAgent
from sb3_dreamer_urlb.intrinsic import EncodedSteps
from sb3_dreamer_urlb.intrinsic.method import check_reward
from sb3_dreamer_urlb.learning.base import BaseLearner
from sb3_dreamer_urlb.learning.optim import ClippedAdam
from sb3_dreamer_urlb.types import Metrics, StepBatch


@dataclass(frozen=True)
class DrQLearnerConfig:
    """The numbers of an update; see :class:`~sb3_dreamer_urlb.DrQv2` for what each means and its default."""

    learning_rate: float
    adam_eps: float
    tau: float
    noise_clip: float
    freeze_encoder: bool
    max_grad_norm: float = math.inf
    weight_decay: float = 0.0
    precision: str = "float32"
    compile: str = "eager"


class DrQLearner(BaseLearner[DrQAgent, StepBatch]):
    """Trains an agent: intrinsic reward, encoder, critic, actor.

    The encoder learns from the critic's loss on a task. While pre-training, a method whose loss trains the encoder takes it
    over; actor and critic then learn on its encodings as they are. In an update in which that loss does not reach the encoder,
    or there is none, the critic's trains it.

    :param agent: the networks
    :param config: the numbers
    """

    def __init__(self, agent: DrQAgent, config: DrQLearnerConfig):
        super().__init__(agent, config.compile, config.precision, width=0)
        self.config = config
        #: standard deviation of the actor's noise, on the device, so that a recorded update follows a schedule, too
        self.noise_std = th.zeros((), device=self.device)
        intrinsic = agent.intrinsic
        encoder = [] if config.freeze_encoder else list(agent.encoder.parameters())
        self._encoder = encoder
        #: whether the intrinsic reward's loss may train the encoder
        self.taken_over = intrinsic is not None and intrinsic.takes_encoder_over()
        self.actor_optimizer = self._optimizer(agent.actor.parameters())
        self.critic_optimizer = self._optimizer([*agent.critic.parameters(), *(() if self.taken_over else encoder)])
        self.intrinsic_optimizer: ClippedAdam | None = None
        if intrinsic is not None:
            trained = [parameter for parameter in intrinsic.parameters() if parameter.requires_grad]
            trained += encoder if self.taken_over else []
            if trained:
                self.intrinsic_optimizer = self._optimizer(trained)
        self._get_ready([] if intrinsic is None else [intrinsic], intrinsic)

    def _optimizer(self, parameters: Iterable[nn.Parameter]) -> ClippedAdam:
        config = self.config
        return ClippedAdam(parameters, config.learning_rate, config.adam_eps, config.max_grad_norm, config.weight_decay)

    def optimizers(self) -> dict[str, ClippedAdam]:
        """All optimisers by name; the names are those of snapshots."""
        found = {
            "actor_optimizer": self.actor_optimizer,
            "critic_optimizer": self.critic_optimizer,
            "intrinsic_optimizer": self.intrinsic_optimizer,
        }
        return {name: optimizer for name, optimizer in found.items() if optimizer is not None}

    def set_noise(self, std: float) -> None:
        """Change the standard deviation of the actor's noise."""
        self.noise_std.fill_(std)

    def _memory(self) -> Iterator[th.Tensor]:
        yield self.noise_std
        yield from super()._memory()

    def _update_all(self, batch: StepBatch) -> Metrics:
        agent, config = self.agent, self.config
        with self._products():
            encoding = agent.encode(batch.observation, augment=True)
            with th.no_grad():
                next_encoding = agent.encode(batch.next_observation, augment=True)
        steps = EncodedSteps(encoding, batch.action, next_encoding)
        reward, metrics = self._reward(steps, batch.reward)
        metrics.update(self._update_critic(encoding, next_encoding, reward, batch))
        metrics.update(self._update_actor(encoding.detach()))
        polyak_update(agent.critic.parameters(), agent.target_critic.parameters(), config.tau)
        return {**metrics, "reward": reward.mean(), "task_reward": batch.reward.mean()}

    def _reward(self, steps: EncodedSteps, task_reward: th.Tensor) -> tuple[th.Tensor, Metrics]:
        """What each step was worth, (B,): to the intrinsic reward after its own step, or to the task."""
        intrinsic = self.agent.intrinsic
        if intrinsic is None:
            return task_reward, {}
        detached = EncodedSteps(steps.encoding.detach(), steps.action, steps.next_encoding)
        if self.intrinsic_optimizer is not None:
            self.intrinsic_optimizer.reached = []
        with self._products():
            learnt = intrinsic.loss(steps if self.taken_over else detached)
        metrics = self._step_intrinsic(intrinsic, learnt, self.intrinsic_optimizer)
        with th.no_grad(), self._products():
            reward = intrinsic.reward(detached)
        check_reward(intrinsic, "reward", reward, task_reward.shape, "(B,)")
        metrics["intrinsic_reward"] = reward.mean()
        return reward, metrics

    def _update_critic(self, encoding: th.Tensor, next_encoding: th.Tensor, reward: th.Tensor, batch: StepBatch) -> Metrics:
        """Both critics towards r + γ^n · min Q̄(s', a'), a' the actor's with clipped noise; and the encoder, if it is left."""
        agent = self.agent
        left = self._encoder_is_left()
        with th.no_grad(), self._products():
            next_action = agent.actor(next_encoding, self.noise_std).sample(noise_clip=self.config.noise_clip)
            next_value = agent.target_critic(next_encoding, next_action).amin(-1)
            target = reward + batch.discount * next_value
        with self._products():
            values = agent.critic(encoding if left else encoding.detach(), batch.action)
        loss = (values - target.unsqueeze(-1)).square().mean(0).sum()
        if left and self.taken_over:
            # It stays in the optimiser where it was put: whether a method's loss reaches it is known now only.
            assert self.intrinsic_optimizer is not None
            self.intrinsic_optimizer.step(loss, partly=True, again=True)
        norm = self.critic_optimizer.step(loss)
        return {
            "critic_loss": loss.detach(),
            "critic_grad_norm": norm,
            "critic": values.detach().mean(),
            "critic_target": target.mean(),
        }

    def _encoder_is_left(self) -> bool:
        """Whether the encoder has not learnt in this update, and is to."""
        if not self.taken_over or not self._encoder:
            return bool(self._encoder)
        assert self.intrinsic_optimizer is not None
        return not any(parameter is self._encoder[0] for parameter in self.intrinsic_optimizer.reached)

    def _update_actor(self, encoding: th.Tensor) -> Metrics:
        """Up the smaller value of its own actions; the encoder learns nothing from that."""
        agent = self.agent
        with self._products():
            action = agent.actor(encoding, self.noise_std).sample(noise_clip=self.config.noise_clip)
            loss = -agent.critic(encoding, action).amin(-1).mean()
        norm = self.actor_optimizer.step(loss)
        return {"actor_loss": loss.detach(), "actor_grad_norm": norm}
