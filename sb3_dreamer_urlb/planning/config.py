"""What a planner is told (its hyperparameters) and what it sees of an agent."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch as th

from sb3_dreamer_urlb.number_checks import check_integer, check_switch, is_finite_number
from sb3_dreamer_urlb.types import LatentState

#: of the Gaussian over actions that a plan begins with
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
        check_switch("planner use_value", self.use_value)
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
                f"planner top_k must be at most the number of trajectories (n_samples={self.n_samples} and "
                f"{self.actor_trajectories} of the actor's), got {self.top_k}: fewer samples go with a smaller top_k."
            )

    @property
    def actor_trajectories(self) -> int:
        """P, how many of the trajectories the actor proposes: ⌊mixture · N⌋."""
        return int(self.mixture * self.n_samples)
