"""Actor and critic that learn in imagination (paper §2, docs/algorithm.md, "Behaviour")."""

from __future__ import annotations

from collections.abc import Sequence

import torch as th
import torch.nn.functional as F
from torch import nn

from sb3_dreamer_urlb.nn import distributions
from sb3_dreamer_urlb.nn.distributions import BoundedNormal, OneHotChoices
from sb3_dreamer_urlb.nn.nets import MLP
from sb3_dreamer_urlb.nn.precision import full
from sb3_dreamer_urlb.types import Imagination, Metrics

MIN_STD = 0.1
#: where the actor's gradient comes from: through the model's dynamics, or by the score function (REINFORCE)
DYNAMICS, REINFORCE = ACTOR_GRADIENTS = ("dynamics", "reinforce")
AUTO = "auto"


class Actor(nn.Module):
    """π(a | z): a bounded normal with mean tanh(m) and standard deviation 2·σ(s/2) + 0.1.

    :param feature_size: F
    :param action_size: A
    :param net_arch: widths of the hidden layers
    :param skill_size: W, 0 without skills: π(a | z, w)
    """

    def __init__(self, feature_size: int, action_size: int, net_arch: Sequence[int], skill_size: int = 0):
        super().__init__()
        self.body = MLP(feature_size + skill_size, net_arch, action_size)
        self.out_std = nn.Linear(self.body.out.in_features, action_size)
        self.action_size = action_size

    def forward(self, feature: th.Tensor, skill: th.Tensor | None = None) -> BoundedNormal:
        """(…, F) and the skill followed there, (…, W), → distribution over (…, A)."""
        hidden = self.body.hidden(_with_skill(feature, skill))
        # Both outputs are one product.
        weight, bias = (th.cat(pair) for pair in zip(self.body.out.parameters(), self.out_std.parameters(), strict=True))
        mean, std = full(F.linear(hidden, weight, bias)).chunk(2, -1)
        return BoundedNormal(th.tanh(mean), 2 * th.sigmoid(std / 2) + MIN_STD)


class CategoricalActor(MLP):
    """π(a | z) over choices among classes: one-hot actions whose samples carry straight-through gradients.

    :param feature_size: F
    :param classes: number of classes of each choice
    :param net_arch: widths of the hidden layers
    :param skill_size: W, 0 without skills: π(a | z, w)
    """

    def __init__(self, feature_size: int, classes: Sequence[int], net_arch: Sequence[int], skill_size: int = 0):
        super().__init__(feature_size + skill_size, net_arch, sum(classes))
        self.scalar = False
        self.classes = tuple(classes)
        self.action_size = sum(classes)

    def forward(self, feature: th.Tensor, skill: th.Tensor | None = None) -> OneHotChoices:  # type: ignore[override]
        """(…, F) and the skill followed there, (…, W), → distribution over (…, A)."""
        return OneHotChoices(super().forward(_with_skill(feature, skill)), self.classes)


class Critic(MLP):
    """v(z): the mean of a unit normal over the λ-return.

    :param feature_size: F
    :param net_arch: widths of the hidden layers
    :param skill_size: W, 0 without skills: v(z, w)
    :param outputs: of the network
    """

    def __init__(self, feature_size: int, net_arch: Sequence[int], skill_size: int = 0, outputs: int = 1):
        super().__init__(feature_size + skill_size, net_arch, outputs)

    def forward(self, feature: th.Tensor, skill: th.Tensor | None = None) -> th.Tensor:
        """Values of states, (…, F) and the skill followed there, (…, W), → (…)."""
        return super().forward(_with_skill(feature, skill))

    def loss(self, value: th.Tensor, target: th.Tensor, weight: th.Tensor) -> th.Tensor:
        """Weighted negative log-likelihood of the targets under a unit normal at the critic's value, all (H, N)."""
        return (weight * distributions.unit_normal_nll(value, target)).mean()


class SuccessorCritic(Critic):
    """v(z, w) = ψ(z, w) · w with successor features ψ (APS).

    :param feature_size: F
    :param net_arch: widths of the hidden layers
    :param skill_size: W
    """

    def __init__(self, feature_size: int, net_arch: Sequence[int], skill_size: int):
        super().__init__(feature_size, net_arch, skill_size, outputs=skill_size)

    def forward(self, feature: th.Tensor, skill: th.Tensor | None = None) -> th.Tensor:
        assert skill is not None
        return (super().forward(feature, skill) * skill).sum(-1)

    def loss(self, value: th.Tensor, target: th.Tensor, weight: th.Tensor) -> th.Tensor:
        """Weighted squared error, all (H, N)."""
        return (weight * (value - target).square()).mean()


def _with_skill(feature: th.Tensor, skill: th.Tensor | None) -> th.Tensor:
    """[z, w]; one skill each is followed through any dimensions before the last two of ``feature``."""
    if skill is None:
        return feature
    return th.cat([feature, skill.expand(*feature.shape[:-1], -1)], -1)


class RewardNormalizer(nn.Module):
    """Divides rewards by an exponential moving average of their mean absolute value (paper, appendix B).

    :param momentum: μ in m ← μ·m + (1 − μ)·mean|r|; 1 switches it off
    """

    scale: th.Tensor

    def __init__(self, momentum: float):
        super().__init__()
        self.momentum = momentum
        self.register_buffer("scale", th.ones(()))

    def forward(self, reward: th.Tensor) -> th.Tensor:
        """Take ``reward`` (any shape) into the average, then normalise it by the average."""
        with th.no_grad():
            self.scale.lerp_(reward.abs().mean(), 1 - self.momentum)
        # A copy: the buffer changes in place at the next call, while autograd still needs today's value.
        return reward / (self.scale.clone() + 1e-8)


def choose_gradient(actor_gradient: str, classes: Sequence[int]) -> str:
    """What ``"auto"`` means: as in Hafner et al., 2021, the dynamics for numbers, REINFORCE for choices.

    :param actor_gradient: one of ``ACTOR_GRADIENTS``, or ``AUTO``
    :param classes: number of classes of each choice that is an action; empty where actions are numbers
    """
    if actor_gradient != AUTO:
        return actor_gradient
    return REINFORCE if classes else DYNAMICS


def with_entropy_bonus(returns: th.Tensor, entropy: th.Tensor, ent_coef: float) -> th.Tensor:
    """What actor and critic aim at: λ-returns, from z_1 on with the entropy of the choice that led there.

    No text says that the critic's targets carry the bonus too: the authors' code adds it in place, to the λ-returns that
    the critic then learns, and their numbers include it (≈ 5e-4 at ent_coef 1e-4).

    :param returns: λ-returns of z_0 … z_{H-1}, float (H, N)
    :param entropy: of the actor at z_0 … z_{H-1}, float (H, N)
    :param ent_coef: weight of the bonus
    """
    return th.cat([returns[:1], returns[1:] + ent_coef * entropy[:-1]])


def actor_loss(target: th.Tensor, weight: th.Tensor) -> th.Tensor:
    """− mean(weight · target of the next state); gradients flow through the dynamics (``actor_grad = dynamics``).

    :param target: of z_0 … z_{H-1}, with gradients to the actor, float (H, N)
    :param weight: of z_0 … z_{H-1}, float (H, N)
    """
    return -(weight[:-1] * target[1:]).mean()


def reinforce_loss(
    target: th.Tensor, value: th.Tensor, weight: th.Tensor, log_prob: th.Tensor, entropy: th.Tensor, ent_coef: float
) -> th.Tensor:
    """− mean(weight · (log π(a) · (target of the next state − value of this one) + ent_coef · entropy)) (Hafner et al., 2021).

    The model passes no gradient on: with one-hot actions and one-hot states it would be straight-through all the way.

    :param target: of z_0 … z_{H-1}, float (H, N); taken as constants
    :param value: the slow critic's, of z_0 … z_H, float (H + 1, N); the baseline, taken as constants
    :param weight: of z_0 … z_{H-1}, float (H, N)
    :param log_prob: of the actions chosen in z_0 … z_{H-1}, with gradients to the actor, float (H, N)
    :param entropy: of the actor there, with gradients, float (H, N)
    :param ent_coef: weight of the entropy
    """
    advantage = (target[1:] - value[:-2]).detach()
    return -(weight[:-1] * (log_prob[:-1] * advantage + ent_coef * entropy[:-1])).mean()


def discount_weights(discount: th.Tensor) -> th.Tensor:
    """How likely each state is to be reached: the product of the discounts before it, (H + 1, N) → (H, N)."""
    return th.cat([th.ones_like(discount[:1]), discount[:-2].cumprod(0)])


def behavior_metrics(imagination: Imagination, raw_reward: th.Tensor, reward: th.Tensor, returns: th.Tensor) -> Metrics:
    """What one wants to see of a behaviour update, detached scalars."""
    with th.no_grad():
        return {
            "imagined_reward": raw_reward.mean(),
            "imagined_reward_std": raw_reward.std(),
            "normalized_reward": reward.mean(),
            "critic_target": returns.mean(),
            "actor_entropy": imagination.entropy[:-1].mean(),
        }
