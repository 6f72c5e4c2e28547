"""Dyna-MPC (paper §3.1, algorithm 1; details in docs/algorithm.md, "Dyna-MPC"): plan with the model, the actor and the critic.

Symbols: n environments, H horizon, N sampled and P actor trajectories, M = N + P, A action size.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch as th

from sb3_dreamer_urlb.behavior.returns import lambda_return
from sb3_dreamer_urlb.nn import distributions
from sb3_dreamer_urlb.number_checks import check_integer, is_finite_number
from sb3_dreamer_urlb.types import LatentState

MAX_STD = 2.0


class PlannableModel(Protocol):
    """All that a planner sees of an agent."""

    def step(self, state: LatentState, action: th.Tensor, generator: th.Generator | None) -> LatentState:
        """Sample the next state from the prior."""

    def imagine(self, state: LatentState, action: th.Tensor, generator: th.Generator | None) -> th.Tensor:
        """What the three below read of states 1 … H, sampled from the prior with the actions (n, H, A): (H, n, F), or anything
        else that slices like it."""

    def rewards(self, feature: th.Tensor) -> th.Tensor:
        """Predicted reward of each state, (…, F) → (…)."""

    def values(self, feature: th.Tensor) -> th.Tensor:
        """Slow critic's value of each state, (…, F) → (…)."""

    def discounts(self, feature: th.Tensor) -> th.Tensor:
        """How much the future after each state counts, (…, F) → (…)."""

    def act(self, feature: th.Tensor, generator: th.Generator | None) -> th.Tensor:
        """Sample the actor, (…, F) → (…, A)."""


@dataclass(frozen=True)
class PlannerConfig:
    """Hyperparameters of the planner; the defaults are the paper's.

    :param horizon: H, steps to look ahead, at least 2
    :param n_samples: N, action sequences drawn from the Gaussian in each iteration
    :param iterations: J, refinements of the Gaussian
    :param top_k: elites that refine it
    :param mixture: actor trajectories as a share of N: P = ⌊mixture · N⌋
    :param temperature: τ, how strongly better elites weigh
    :param momentum: how much of the old mean stays in each refinement
    :param min_std: lower bound of the Gaussian's standard deviation
    :param use_value: bootstrap with the slow critic; False sums rewards only (MPPI)
    """

    horizon: int = 5
    n_samples: int = 512
    iterations: int = 12
    top_k: int = 64
    mixture: float = 0.05
    temperature: float = 0.5
    momentum: float = 0.1
    min_std: float = 0.1
    use_value: bool = True

    def __post_init__(self) -> None:
        for name, least in (("horizon", 2), ("n_samples", 1), ("iterations", 1), ("top_k", 1)):
            check_integer(f"planner {name}", getattr(self, name), least)
        for name in ("mixture", "temperature", "momentum", "min_std"):
            value = getattr(self, name)
            if not is_finite_number(value):
                raise ValueError(f"planner {name} must be a finite number, got {value!r}.")
        if not 0 <= self.mixture <= 1:
            raise ValueError(f"planner mixture must lie in [0, 1], got {self.mixture!r}.")
        if not 0 <= self.momentum < 1:
            raise ValueError(f"planner momentum must lie in [0, 1), got {self.momentum!r}.")
        if self.temperature <= 0:
            raise ValueError(f"planner temperature must be positive, got {self.temperature!r}.")
        if not 0 < self.min_std <= MAX_STD:
            raise ValueError(f"planner min_std must lie in (0, {MAX_STD:g}], got {self.min_std!r}.")
        if self.top_k > self.n_samples + self.actor_trajectories:
            raise ValueError(
                f"planner top_k must be at most the number of trajectories "
                f"({self.n_samples} + {self.actor_trajectories}), got {self.top_k}."
            )

    @property
    def actor_trajectories(self) -> int:
        """P."""
        return int(self.mixture * self.n_samples)


class DynaMPC:
    """Refines a Gaussian over action sequences inside the model and acts with one of its elites.

    :param config: hyperparameters
    :param gae_lambda: λ of the returns that rank trajectories, the one the critic was trained with
    """

    #: number of classes of each choice that is an action; none where actions are numbers
    classes: tuple[int, ...] = ()

    def __init__(self, config: PlannerConfig, gae_lambda: float):
        self.config = config
        self.gae_lambda = gae_lambda

    def plan(
        self,
        model: PlannableModel,
        state: LatentState,
        previous_mean: th.Tensor,
        generator: th.Generator | None,
        explore: bool,
    ) -> tuple[th.Tensor, th.Tensor]:
        """Choose an action for each environment.

        :param model: what to plan in
        :param state: current posterior states, (n, …)
        :param previous_mean: the mean that the last step returned, zeros where an episode begins, float (n, H, A)
        :param generator: source of randomness, the global one if None
        :param explore: add the Gaussian's noise to the action
        :return: action in [-1, 1], float (n, A), and the mean to hand in at the next step, float (n, H, A)
        """
        mean = _shifted(previous_mean)
        std = th.full_like(mean, MAX_STD)
        proposals = self._actor_proposals(model, state, generator)
        trajectories = state.repeat(self.config.n_samples + proposals.shape[1])
        noise = self._sampling_noise(mean, generator)
        for j in range(self.config.iterations):
            samples = (mean.unsqueeze(1) + std.unsqueeze(1) * noise[j]).clamp(-1, 1)
            actions = th.cat([samples, proposals], 1)
            value = self._evaluate(model, trajectories, actions, generator)
            elites, weight = self._elites(actions, value)
            mean, std = self._refine(mean, elites, weight)
        action = self._draw_elite(elites, weight, generator)
        if explore:
            action = action + std[:, 0] * self._exploration_noise(action, generator)
        return action.clamp(-1, 1), mean

    # -- what a trajectory is worth ----------------------------------------------------------------------------------------

    def _evaluate(
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

    def _elites(self, actions: th.Tensor, value: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
        """The best sequences, float (n, k, H, A), and their weights ρ, which sum to one, float (n, k)."""
        best, index = value.topk(self.config.top_k, dim=1)
        elites = actions.gather(1, index[:, :, None, None].expand(-1, -1, *actions.shape[2:]))
        return elites, (self.config.temperature * best).softmax(1)

    @staticmethod
    def _draw_elite(elites: th.Tensor, weight: th.Tensor, generator: th.Generator | None) -> th.Tensor:
        """The first action of one elite, drawn by its weight, float (n, A)."""
        chosen = distributions.draw_classes(weight, generator)
        return elites[th.arange(len(elites), device=elites.device), chosen, 0]

    def _refine(self, mean: th.Tensor, elites: th.Tensor, weight: th.Tensor) -> tuple[th.Tensor, th.Tensor]:
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
