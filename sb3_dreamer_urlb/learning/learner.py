"""One update on one batch: losses → backward → optimiser steps. The only place that trains world model, actor and critic."""

from __future__ import annotations

from collections.abc import Hashable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

import torch as th
from torch import nn

from sb3_dreamer_urlb.agent import Agent
from sb3_dreamer_urlb.behavior import actor_critic
from sb3_dreamer_urlb.behavior.actor_critic import DYNAMICS
from sb3_dreamer_urlb.behavior.returns import lambda_return
from sb3_dreamer_urlb.intrinsic.base import RewardSource
from sb3_dreamer_urlb.intrinsic.method import check_reward
from sb3_dreamer_urlb.learning.base import BaseLearner
from sb3_dreamer_urlb.learning.optim import ClippedAdam
from sb3_dreamer_urlb.nn import distributions
from sb3_dreamer_urlb.types import Imagination, LatentState, Metrics, Observation, Posterior, SequenceBatch


@dataclass(frozen=True)
class LearnerConfig:
    """The numbers of an update: the algorithm's arguments of the same names, where each is explained and has its default."""

    learning_rate: float
    actor_learning_rate: float
    critic_learning_rate: float
    adam_eps: float
    max_grad_norm: float
    weight_decay: float
    free_nats: float
    kl_balance: float
    imagination_horizon: int
    gae_lambda: float
    target_update_interval: int
    ent_coef: float
    reward_trains_model: bool
    trains_behavior: bool = True
    precision: str = "float32"
    kl_scale: float = 1.0
    actor_gradient: str = DYNAMICS
    compile: str = "eager"
    trains_decoder: bool = True


class Learner(BaseLearner[Agent, SequenceBatch]):
    """Trains an agent: intrinsic reward, world model, actor, critic.

    The intrinsic reward comes first because some methods label the rewards that the reward head learns. It reads what the
    world model inferred before its step, so for the others the order makes no difference (docs/algorithm.md, "Order of an
    update").

    :param agent: the networks
    :param config: the numbers
    """

    def __init__(self, agent: Agent, config: LearnerConfig):
        super().__init__(agent, config.compile, config.precision, agent.world_model.sizes.feature)
        self.config = config
        # Frozen, what a latent state looks like stays what it was (paper, appendix "Latent Dynamics Discrepancy").
        agent.world_model.decoder.requires_grad_(config.trains_decoder)
        self.model_optimizer = self._optimizer(agent.world_model, config.learning_rate)
        self.actor_optimizer = self._optimizer(agent.actor, config.actor_learning_rate)
        self.critic_optimizer = self._optimizer(agent.critic, config.critic_learning_rate)
        self.intrinsic_optimizer: ClippedAdam | None = None
        self.reward_source = RewardSource()
        if agent.intrinsic is not None and agent.explores:
            self.reward_source = agent.intrinsic
            if any(parameter.requires_grad for parameter in agent.intrinsic.parameters()):
                self.intrinsic_optimizer = self._optimizer(agent.intrinsic, config.learning_rate)
        self.task_reward_optimizer: ClippedAdam | None = None
        if (heads := agent.task_rewards or agent.task_reward) is not None:
            self.task_reward_optimizer = self._optimizer(heads, config.learning_rate)
        statistics = [agent.reward_normalizer, *([] if agent.intrinsic is None else [agent.intrinsic])]
        self._get_ready(statistics, agent.intrinsic)

    def _optimizer(self, module: nn.Module, learning_rate: float) -> ClippedAdam:
        config = self.config
        trained = [parameter for parameter in module.parameters() if parameter.requires_grad]
        return ClippedAdam(trained, learning_rate, config.adam_eps, config.max_grad_norm, config.weight_decay)

    def optimizers(self) -> dict[str, ClippedAdam]:
        """All optimisers by name; the names are those of snapshots."""
        found = {
            "model_optimizer": self.model_optimizer,
            "actor_optimizer": self.actor_optimizer,
            "critic_optimizer": self.critic_optimizer,
            "intrinsic_optimizer": self.intrinsic_optimizer,
            "task_reward_optimizer": self.task_reward_optimizer,
        }
        return {name: optimizer for name, optimizer in found.items() if optimizer is not None}

    def _after_update(self) -> None:
        if self.trains_behavior() and self.updates % self.config.target_update_interval == 0:
            self.agent.slow_critic.load_state_dict(self.agent.critic.state_dict())

    def trains_behavior(self) -> bool:
        """Whether actor and critic learn: not where nobody asks them (MPPI), nor while they have nothing to learn."""
        return self.config.trains_behavior and self.agent.trains_behavior()

    def _situation(self) -> tuple[Hashable, ...]:
        """What decides on the host which way an update goes."""
        skills = self.agent.skills
        return self.trains_behavior(), skills is not None and skills.is_fixed

    def _update_all(self, batch: SequenceBatch) -> Metrics:
        model = self.agent.world_model
        observation = model.preprocess(batch.observation)
        with self._products():
            posterior = model.observe(observation, batch.action, batch.is_first)
        metrics = self._update_intrinsic(_detached(posterior), batch)
        metrics.update(self._update_world_model(posterior, observation, batch))
        metrics.update(self._update_task_reward(_detached(posterior), batch))
        if self.trains_behavior():
            metrics.update(self._update_behavior(posterior.state.detach(), batch.is_terminal))
            if self.agent.explores:
                metrics["intrinsic_reward"] = metrics["imagined_reward"]
        return metrics

    def _update_intrinsic(self, posterior: Posterior, batch: SequenceBatch) -> Metrics:
        with self._products():
            learnt = self.reward_source.loss(posterior, batch)
        return self._step_intrinsic(self.reward_source, learnt, self.intrinsic_optimizer)

    def _update_world_model(self, posterior: Posterior, observation: Observation, batch: SequenceBatch) -> Metrics:
        config = self.config
        with self._products():
            reward = self.reward_source.replay_reward(_detached(posterior), batch)
            check_reward(self.reward_source, "replay_reward", reward, batch.reward.shape, "(B, T)")
            loss, metrics = self.agent.world_model.loss(
                posterior,
                observation,
                reward,
                batch.is_terminal,
                config.free_nats,
                config.kl_balance,
                config.reward_trains_model,
                config.kl_scale,
            )
        if reward is not batch.reward:
            metrics["intrinsic_replay_reward"] = reward.mean()
            metrics["intrinsic_replay_reward_std"] = reward.std()
        metrics["model_grad_norm"] = self.model_optimizer.step(loss)
        return metrics

    def _update_task_reward(self, posterior: Posterior, batch: SequenceBatch) -> Metrics:
        """What the task would pay, learnt beside the intrinsic reward; touches neither model nor exploration."""
        optimizer = self.task_reward_optimizer
        if optimizer is None:
            return {}
        with self._products():
            loss = th.stack([
                distributions.unit_normal_nll(head(posterior.feature), reward).mean() for head, reward in self._tasks(batch)
            ]).sum()  # fmt: skip
        return {"task_reward_grad_norm": optimizer.step(loss), "task_reward_loss": loss.detach()}

    def _tasks(self, batch: SequenceBatch) -> Iterator[tuple[nn.Module, th.Tensor]]:
        """Each head beside the model's own, and what it learns."""
        if self.agent.task_rewards is None:
            assert self.agent.task_reward is not None
            yield self.agent.task_reward, batch.reward
            return
        assert batch.task_rewards is not None
        yield from zip(self.agent.task_rewards.values(), batch.task_rewards.unbind(-1), strict=True)

    def _update_behavior(self, start: LatentState, is_terminal: th.Tensor) -> Metrics:
        agent, config = self.agent, self.config
        start, goes_on = start.flatten(), (~is_terminal).flatten().to(start.deter.dtype)
        skill = None if agent.skills is None else agent.skills.sample(start.deter.shape[0])
        with _frozen(agent.world_model, agent.slow_critic, agent.intrinsic), self._products():
            imagination, log_prob = self._imagine(start, skill)
            raw_reward = self.reward_source.reward(imagination, agent.world_model.reward)
            check_reward(self.reward_source, "reward", raw_reward, imagination.seen.shape[:-1], "(H + 1, N)")
            reward = agent.reward_normalizer(raw_reward)
            discount = agent.world_model.discount(imagination.seen, goes_on)
            value = agent.slow_critic(imagination.seen, skill)
            weight = actor_critic.discount_weights(discount.detach())
            returns = lambda_return(reward[:-1], value, discount[:-1], config.gae_lambda)
            target = actor_critic.with_entropy_bonus(returns, imagination.entropy, config.ent_coef)
            # Nothing is chosen where the episode is over, though a dream begins there.
            chosen = weight * goes_on
            if log_prob is None:
                loss = actor_critic.actor_loss(target, chosen)
            else:
                loss = actor_critic.reinforce_loss(target, value, chosen, log_prob, imagination.entropy, config.ent_coef)
        actor_grad_norm = self.actor_optimizer.step(loss)
        with self._products():
            value_now = agent.critic(imagination.seen[:-1].detach(), skill)
            critic_loss = agent.critic.loss(value_now, target.detach(), weight)
        critic_grad_norm = self.critic_optimizer.step(critic_loss)
        return {
            **actor_critic.behavior_metrics(imagination, raw_reward, reward, returns),
            "actor_loss": loss.detach(),
            "actor_grad_norm": actor_grad_norm,
            "critic_loss": critic_loss.detach(),
            "critic_grad_norm": critic_grad_norm,
            "critic": value_now.detach().mean(),
        }

    def _imagine(self, start: LatentState, skill: th.Tensor | None) -> tuple[Imagination, th.Tensor | None]:
        """Dreams, and what REINFORCE needs: log-probabilities of their actions, float (H, N), else None."""
        agent, horizon = self.agent, self.config.imagination_horizon
        if self.config.actor_gradient == DYNAMICS:
            return agent.world_model.imagine(agent.actor, start, horizon, skill), None
        with th.no_grad():
            imagination = agent.world_model.imagine(agent.actor, start, horizon, skill)
        # Once more with gradients, in one pass over all steps.
        policy = agent.actor(imagination.seen[:-1], skill)
        return replace(imagination, entropy=policy.entropy()), policy.log_prob(imagination.action[1:])


def _detached(posterior: Posterior) -> Posterior:
    return Posterior(
        posterior.state.detach(),
        posterior.feature.detach(),
        posterior.embed.detach(),
        posterior.post_logits.detach(),
        posterior.prior_logits.detach(),
        posterior.kl,
    )


@contextmanager
def _frozen(*modules: nn.Module | None) -> Iterator[None]:
    """Let gradients pass through the modules to their inputs only: their weights' gradients are not computed."""
    parameters = [p for module in modules if module is not None for p in module.parameters() if p.requires_grad]
    for parameter in parameters:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in parameters:
            parameter.requires_grad_(True)
