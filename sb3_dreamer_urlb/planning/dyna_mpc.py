"""Dyna-MPC (paper §3.1, algorithm 1; details in docs/algorithm.md, "Dyna-MPC"): plan with the model, the actor and the critic.

Symbols: n environments, H horizon, N sampled and P actor trajectories, M = N + P, A action size.
"""

from __future__ import annotations

import torch as th

from sb3_dreamer_urlb.behavior.returns import lambda_return
from sb3_dreamer_urlb.nn import distributions
from sb3_dreamer_urlb.planning.base import Planner
from sb3_dreamer_urlb.planning.config import MAX_STD, PlannableModel
from sb3_dreamer_urlb.types import LatentState


class DynaMPC(Planner):
    """Refines a Gaussian over action sequences inside the model and acts with one of its elites.

    :param config: hyperparameters
    :param gae_lambda: λ of the returns that rank trajectories, the one the critic was trained with
    """

    def plan(
        self,
        model: PlannableModel,
        state: LatentState,
        previous_mean: th.Tensor,
        generator: th.Generator | None,
        explore: bool,
    ) -> tuple[th.Tensor, th.Tensor]:
        """See :meth:`Planner.plan`; the mean is the Gaussian's, whose noise exploration adds."""
        mean = _shifted(previous_mean)
        std = th.full_like(mean, MAX_STD)
        proposals = self._actor_proposals(model, state, generator)
        trajectories = state.repeat(self.config.n_samples + proposals.shape[1])
        noise = self._sampling_noise(mean, generator)
        for j in range(self.config.iterations):
            samples = (mean.unsqueeze(1) + std.unsqueeze(1) * noise[j]).clamp(-1, 1)
            actions = th.cat([samples, proposals], 1)
            elites, weight = self._ranked(model, trajectories, actions, generator)
            mean, std = self.returned("refine", self.refine(mean, elites, weight), mean.shape, mean.shape)
        action = self._draw_elite(elites, weight, generator)
        if explore:
            action = action + std[:, 0] * self._exploration_noise(action, generator)
        return action.clamp(-1, 1), mean

    # -- what a trajectory is worth ----------------------------------------------------------------------------------------

    def _ranked(
        self, model: PlannableModel, state: LatentState, actions: th.Tensor, generator: th.Generator | None
    ) -> tuple[th.Tensor, th.Tensor]:
        """The elites among the trajectories and their weights, by :meth:`evaluate` and :meth:`elites`."""
        value = self.returned("evaluate", self.evaluate(model, state, actions, generator), actions.shape[:2])
        n, _, *sequence = actions.shape
        elites, weight = self.returned("elites", self.elites(actions, value), (n, None, *sequence), (n, None))
        return elites, weight

    def evaluate(
        self, model: PlannableModel, state: LatentState, actions: th.Tensor, generator: th.Generator | None
    ) -> th.Tensor:
        """The λ-return at state 1 of each trajectory (the reward of state 0 is the same for all), float (n, M)."""
        feature = model.imagine(state, actions.flatten(0, 1), generator)
        reward, discount = model.rewards(feature[:-1]), model.discounts(feature[:-1])
        # Index 0 of the values is never read by the return.
        value = reward.new_zeros(actions.shape[2], *reward.shape[1:])
        if self.config.use_value:
            value[1:] = model.values(feature[1:])
        return lambda_return(reward, value, discount, self.gae_lambda)[0].view(actions.shape[:2])

    def _actor_proposals(self, model: PlannableModel, state: LatentState, generator: th.Generator | None) -> th.Tensor:
        """Action sequences of the actor, imagined once and used in every iteration: float (n, P, H, A)."""
        n, count, horizon = state.deter.shape[0], self.config.actor_trajectories, self.config.horizon
        state = state.repeat(count)
        actions = [model.act(state.feature, generator)]
        for _ in range(horizon - 1):
            state = model.step(state, actions[-1], generator)
            actions.append(model.act(state.feature, generator))
        return th.stack(actions, 1).view(n, count, horizon, actions[0].shape[-1])

    # -- the Gaussian --------------------------------------------------------------------------------------------------

    def elites(self, actions: th.Tensor, value: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """The best sequences, float (n, k, H, A), and their weights ρ, which sum to one, float (n, k)."""
        best, index = value.topk(self.config.top_k, dim=1)
        elites = actions.gather(1, index[:, :, None, None].expand(-1, -1, *actions.shape[2:]))
        return elites, (self.config.temperature * best).softmax(1)

    @staticmethod
    def _draw_elite(elites: th.Tensor, weight: th.Tensor, generator: th.Generator | None) -> th.Tensor:
        """The first action of one elite, drawn by its weight, float (n, A)."""
        chosen = distributions.draw_classes(weight, generator)
        return elites[th.arange(len(elites), device=elites.device), chosen, 0]

    def refine(self, mean: th.Tensor, elites: th.Tensor, weight: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """Weighted mean and standard deviation of the elites (paper, equation 2), both float (n, H, A)."""
        weight = weight[:, :, None, None]
        elite_mean = (weight * elites).sum(1)
        elite_var = (weight * (elites - elite_mean.unsqueeze(1)).square()).sum(1)
        momentum = self.config.momentum
        return momentum * mean + (1 - momentum) * elite_mean, elite_var.sqrt().clamp(self.config.min_std, MAX_STD)

    # -- its draws -----------------------------------------------------------------------------------------------------

    def _sampling_noise(self, mean: th.Tensor, generator: th.Generator | None) -> th.Tensor:
        """Standard normal, float (J, n, N, H, A)."""
        n, horizon, action_size = mean.shape
        shape = (self.config.iterations, n, self.config.n_samples, horizon, action_size)
        return distributions.draw_normal(shape, mean, generator)

    @staticmethod
    def _exploration_noise(action: th.Tensor, generator: th.Generator | None) -> th.Tensor:
        """Standard normal, float (n, A)."""
        return distributions.draw_normal(action.shape, action, generator)


def _shifted(mean: th.Tensor) -> th.Tensor:
    """Yesterday's plan, one step on: its last action is not known yet."""
    return th.cat([mean[:, 1:], th.zeros_like(mean[:, :1])], 1)
