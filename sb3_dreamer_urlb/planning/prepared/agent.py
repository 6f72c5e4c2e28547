"""An agent's networks made ready for planning on a CPU: the same model with less arithmetic and fewer passes over memory."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch as th

from sb3_dreamer_urlb import native
from sb3_dreamer_urlb.agent import Agent, PlannedAgent
from sb3_dreamer_urlb.behavior.actor_critic import SuccessorCritic
from sb3_dreamer_urlb.nn.nets import MLP
from sb3_dreamer_urlb.nn.precision import product_dtype
from sb3_dreamer_urlb.planning.prepared.native_parts import NativeDynamics, NativeHead
from sb3_dreamer_urlb.planning.prepared.parts import Dynamics, Head, SampledState, Visited
from sb3_dreamer_urlb.types import LatentState

#: states scored at once: what a processor's cache holds
ROWS = 8192


class PreparedAgent(PlannedAgent):
    """:class:`~sb3_dreamer_urlb.agent.PlannedAgent` for one plan on a CPU. What its heads read are states, not features.

    Of torch's operators; see the docstring of ``planning/prepared`` for the forms.

    :param agent: the networks
    :param skill: that each of the n environments follows, float (n, W); W is 0 without skills
    :param dtype: of products
    """

    dynamics_class: ClassVar[type[Dynamics] | type[NativeDynamics]] = Dynamics
    head_class: ClassVar[type[Head] | type[NativeHead]] = Head

    def __init__(self, agent: Agent, skill: th.Tensor, dtype: th.dtype):
        super().__init__(agent, skill)
        model = agent.world_model
        variables, classes = model.rssm.logits_shape

        def head(mlp: MLP) -> Head | NativeHead:
            return self.head_class(mlp, variables, classes, dtype)

        self._dynamics = self.dynamics_class(model.rssm, dtype)
        self._reward, self._value = head(model.reward), head(agent.slow_critic)
        self._discount = None if model.discount_logit is None else head(model.discount_logit)

    def step(  # type: ignore[override]
        self, state: LatentState | SampledState, action: th.Tensor, generator: th.Generator | None
    ) -> SampledState:
        with th.autocast("cpu", enabled=False):
            return self._dynamics.step(state, action, generator)

    def features(self, states: Sequence[SampledState]) -> Visited:  # type: ignore[override]
        return Visited(th.stack([state.classes for state in states]), th.stack([state.short for state in states]))

    def rewards(self, feature: Visited) -> th.Tensor:  # type: ignore[override]
        return self._ask(self._reward, feature).squeeze(-1)

    def values(self, feature: Visited) -> th.Tensor:  # type: ignore[override]
        skill = self._skill_of(feature.short)
        value = self._ask(self._value, feature, skill)
        if skill is None or not isinstance(self.agent.slow_critic, SuccessorCritic):
            return value.squeeze(-1)
        return (value * skill).sum(-1)

    def discounts(self, feature: Visited) -> th.Tensor:  # type: ignore[override]
        gamma = self.agent.world_model.gamma
        if self._discount is None:
            return th.full(feature.short.shape[:2], gamma)
        return gamma * th.sigmoid(self._ask(self._discount, feature).squeeze(-1))

    @staticmethod
    def _ask(head: Head | NativeHead, states: Visited, skill: th.Tensor | None = None) -> th.Tensor:
        classes, short = states.classes.flatten(0, 1), states.short.flatten(0, 1)
        if skill is not None:
            short = th.cat([short, skill.to(short.dtype).repeat(len(states.short), 1)], -1)
        with th.autocast("cpu", enabled=False):
            parts = [head(*part) for part in zip(classes.split(ROWS), short.split(ROWS), strict=True)]
        return (parts[0] if len(parts) == 1 else th.cat(parts)).view(*states.classes.shape[:2], -1)


class NativeAgent(PreparedAgent):
    """The same on kernels of our own; made and asked inside ``native.using()`` where these are fast."""

    dynamics_class = NativeDynamics
    head_class = NativeHead
    _dynamics: NativeDynamics

    def imagine(  # type: ignore[override]
        self, state: LatentState, action: th.Tensor, generator: th.Generator | None
    ) -> Visited:
        """In one pass where the processor has tiles, else step by step."""
        with th.autocast("cpu", enabled=False):
            visited = self._dynamics.imagine(state, action, generator)
        return super().imagine(state, action, generator) if visited is None else visited  # type: ignore[return-value]


def planned(agent: Agent, skill: th.Tensor) -> PlannedAgent:
    """The agent as a planner sees it, in the form for its device: the one place that chooses. Products run in the format that
    autocast asks for now.

    :param agent: the networks
    :param skill: that each of the n environments follows, float (n, W); W is 0 without skills
    """
    if skill.device.type != "cpu":
        return PlannedAgent(agent, skill)
    form = NativeAgent if native.on_lanes() else PreparedAgent
    return form(agent, skill, product_dtype(skill))
