"""An agent in a form made ready for planning is the agent: what the tests of each form compare."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch as th
from golden import deterministic_draws

from sb3_dreamer_urlb.agent import Agent, PlannedAgent
from sb3_dreamer_urlb.intrinsic import make_intrinsic_reward
from sb3_dreamer_urlb.planning.prepared.agent import PreparedAgent
from sb3_dreamer_urlb.types import LatentState
from sb3_dreamer_urlb.world_model.world_model import WorldModel

#: environments, and states of each
N, M = 2, 6
#: intrinsic rewards, and whether there is a discount head
METHODS = [(None, False), (None, True), ("diayn", False), ("aps", False)]


class StepByStep:
    """What a model has that knows single steps only."""

    def imagine(self, state: LatentState, action: th.Tensor, generator: th.Generator | None) -> th.Tensor:
        """See ``PlannableModel.imagine``."""
        features = []
        for its in action.unbind(1):
            state = self.step(state, its, generator)  # type: ignore[attr-defined]
            features.append(state.feature)
        return th.stack(features)


def agent_and_skill(
    world_model: Callable[..., WorldModel], method: str | None, discount_head: bool
) -> tuple[Agent, th.Tensor]:
    """Of N environments.

    :param world_model: the fixture
    :param method: see ``METHODS``
    :param discount_head: likewise
    """
    agent = Agent(world_model(discount_head=discount_head), [8, 8], make_intrinsic_reward(method, {}))
    # Fresh layers hardly differ from none: biases, norms and logits that matter.
    with th.no_grad():
        for parameter in agent.parameters():
            parameter.copy_(0.5 * th.randn_like(parameter))
    return agent, th.zeros(N, 0) if agent.skills is None else agent.skills.draw(N)


def check_states_and_scores(
    plain: PlannedAgent, ready: PreparedAgent, starts: Sequence[LatentState], tolerance: float = 1e-5
) -> None:
    """Three steps from each start, and from the first one twice: the second time it is known.

    :param plain: the agent
    :param ready: the form
    :param starts: of N·M states
    :param tolerance: of scores
    """
    with th.no_grad(), deterministic_draws():
        for start in (starts[0], *starts):
            states = {plain: [start], ready: [start]}
            for _ in range(3):
                action = th.rand(N * M, 2) * 2 - 1
                for its, visited in states.items():
                    visited.append(its.step(visited[-1], action, None))
            features = {its: its.features(visited[1:]) for its, visited in states.items()}
            for a, b in zip(*states.values(), strict=True):
                assert th.allclose(a.feature, b.feature, atol=1e-5)
            for ask in ("rewards", "values", "discounts"):
                a, b = (getattr(its, ask)(feature[1:]) for its, feature in features.items())
                assert a.shape == (2, N * M) and th.allclose(a, b, atol=tolerance), ask
            a, b = (its.act(visited[-1].feature, None) for its, visited in states.items())
            assert th.allclose(a, b, atol=1e-5)


def check_short_products(make: Callable[[th.dtype], PreparedAgent], start: LatentState) -> None:
    """They change scores, by a little.

    :param make: the form of an agent without skills with products in a format
    :param start: any states
    """
    action, scores = th.rand(len(start.deter), 2), []
    for dtype in (th.float32, th.bfloat16):
        ready = make(dtype)
        with th.no_grad(), deterministic_draws():
            first = ready.step(start, action, None)
            scores.append(ready.values(ready.features([ready.step(first, action, None)])))
        assert scores[-1].dtype == first.deter.dtype == th.float32 and first.short.dtype == dtype
    assert not th.equal(*scores) and th.allclose(*scores, atol=0.05)
