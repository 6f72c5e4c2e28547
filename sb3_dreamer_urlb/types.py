"""The few things that travel between the parts of the agent.

Symbols used everywhere: B sequences a batch, T steps a sequence, N = B·T start states, H imagination horizon,
A action size, D deterministic size, S·K stochastic size (S categoricals of K classes), F = S·K + D feature size,
W skill size.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch as th

from sb3_dreamer_urlb.spaces.observations import Observations
from sb3_dreamer_urlb.spaces.raw import Observation, batch_size, map_observation

__all__ = [
    "Imagination",
    "LatentState",
    "MetricMeans",
    "Metrics",
    "ModelSizes",
    "Observation",
    "Posterior",
    "SequenceBatch",
    "batch_size",
    "map_observation",
]

Metrics = dict[str, th.Tensor]


@dataclass
class SequenceBatch:
    """B sequences of T rows. Row t holds observation t with the action and the reward that *led to* it.

    :param observation: as the environment gave it, e.g. images, uint8 (B, T, C, height, width); by name for Dict spaces
    :param action: float32 (B, T, A) in [-1, 1]; zeros in an episode's first row
    :param reward: float32 (B, T); zero in an episode's first row
    :param is_first: bool (B, T), true for an episode's first row; the first row of every chunk counts as one
    :param is_terminal: bool (B, T), true where the environment terminated (not where it was truncated)
    :param skill: float32 (B, T, W), the skill that each row's action followed; None without skills
    :param task_rewards: float32 (B, T, K), what K tasks of the domain paid for each row; None where nobody learns them
    """

    observation: Observation
    action: th.Tensor
    reward: th.Tensor
    is_first: th.Tensor
    is_terminal: th.Tensor
    skill: th.Tensor | None = None
    task_rewards: th.Tensor | None = None


@dataclass
class StepBatch:
    """B steps of the replay with their n-step returns, for an agent without a world model; s frames make an observation.

    :param observation: where each began, as the environment gave it, e.g. images, uint8 (B, s, C, height, width), oldest first
    :param action: what was done there, float32 (B, A) in [-1, 1]
    :param reward: discounted sum of the n rewards that followed, of fewer where the episode ended, float32 (B,)
    :param discount: of the value where the return ends, float32 (B,): γ to the number of its rewards, 0 where the
        environment terminated (not where it was truncated)
    :param next_observation: where it ends, like ``observation``
    """

    observation: Observation
    action: th.Tensor
    reward: th.Tensor
    discount: th.Tensor
    next_observation: Observation


@dataclass
class LatentState:
    """The model state z of the paper: a stochastic and a deterministic part, both with the same leading shape.

    :param stoch: float (…, S·K), S one-hot vectors one after the other
    :param deter: float (…, D), the recurrent state h of the GRU
    :param classes: the ones' places in ``stoch``, int64 (…, S); only where a planner asked for them
    """

    stoch: th.Tensor
    deter: th.Tensor
    classes: th.Tensor | None = None

    @property
    def feature(self) -> th.Tensor:
        """What every head reads: [stochastic, deterministic], float (…, F)."""
        return th.cat([self.stoch, self.deter], -1)

    def detach(self) -> LatentState:
        """The same state, cut from the graph."""
        return LatentState(self.stoch.detach(), self.deter.detach())

    def masked(self, keep: th.Tensor) -> LatentState:
        """Zero the state where an episode begins.

        :param keep: (…, 1), 1 to keep a row and 0 to reset it
        """
        return LatentState(self.stoch * keep, self.deter * keep)

    def repeat(self, times: int) -> LatentState:
        """Each row ``times`` times in a row: (n, …) → (n·times, …)."""
        return LatentState(self.stoch.repeat_interleave(times, 0), self.deter.repeat_interleave(times, 0))

    def flatten(self) -> LatentState:
        """All leading dimensions as one: (B, T, …) → (B·T, …)."""
        return LatentState(self.stoch.flatten(0, -2), self.deter.flatten(0, -2))


@dataclass
class Posterior:
    """What the world model inferred about a replayed batch.

    :param state: posterior states, (B, T, …)
    :param feature: float (B, T, F), the features of ``state``
    :param embed: encoded observations, float (B, T, E)
    :param post_logits: float (B, T, S, K)
    :param prior_logits: float (B, T, S, K)
    :param kl: KL(posterior ‖ prior) in nats, float (B, T)
    """

    state: LatentState
    feature: th.Tensor
    embed: th.Tensor
    post_logits: th.Tensor
    prior_logits: th.Tensor
    kl: th.Tensor


@dataclass
class Imagination:
    """Trajectories dreamt by the actor inside the model, time first.

    :param seen: what networks see of z_0 … z_H, in the format of their products, (H + 1, N, F); z_0 is where the dream starts
    :param action: float (H + 1, N, A); action t led to state t, so the first is zero
    :param entropy: of the actor at z_0 … z_{H-1} in nats, float (H, N)
    :param skill: that the actor followed, float (N, W), None without skills
    """

    seen: th.Tensor
    action: th.Tensor
    entropy: th.Tensor
    skill: th.Tensor | None = None

    @property
    def feature(self) -> th.Tensor:
        """z_0 … z_H, float (H + 1, N, F). Networks read ``seen`` just as well, without a copy."""
        return self.seen.float()


@dataclass(frozen=True)
class ModelSizes:
    """Sizes that a head or an intrinsic reward needs to know.

    :param action: A
    :param embed: E
    :param feature: F
    :param deter: D
    :param net_arch: widths of the hidden layers of every head, actor and critic
    :param observations: what the model sees
    :param cnn_depth: channels of the encoder's first convolution
    """

    action: int
    embed: int
    feature: int
    deter: int
    net_arch: tuple[int, ...]
    observations: Observations
    cnn_depth: int


class MetricMeans:
    """Running means of metrics, on the device until somebody asks."""

    def __init__(self) -> None:
        self.sums: dict[str, th.Tensor] = {}
        self.counts: dict[str, int] = {}

    def add(self, metrics: Metrics) -> None:
        """Take one update's metrics in."""
        for name, value in metrics.items():
            self.sums[name] = self.sums[name] + value if name in self.sums else value
            self.counts[name] = self.counts.get(name, 0) + 1

    def take(self) -> dict[str, float]:
        """The means since the last call, empty if there was no update. Waits for the device, once."""
        if not self.sums:
            return {}
        sums = th.stack(list(self.sums.values())).tolist()
        means = {name: total / self.counts[name] for name, total in zip(self.sums, sums, strict=True)}
        self.sums, self.counts = {}, {}
        return means
