"""The agent made ready for planning on a CPU is the agent."""

from __future__ import annotations

import pytest
import torch as th
from planning_forms import METHODS, M, N, agent_and_skill, check_short_products, check_states_and_scores

from sb3_dreamer_urlb.agent import Agent, PlannedAgent
from sb3_dreamer_urlb.nn import distributions
from sb3_dreamer_urlb.planning.prepared import agent as prepared
from sb3_dreamer_urlb.planning.prepared import parts as prepared_parts
from sb3_dreamer_urlb.planning.prepared import prepacked
from sb3_dreamer_urlb.planning.prepared.agent import PreparedAgent, planned
from sb3_dreamer_urlb.types import LatentState


@pytest.fixture(params=METHODS, ids=str)
def agents(request, world_model, monkeypatch):
    """The plain and the prepared form of one agent with N environments; several blocks of everything."""
    monkeypatch.setattr(prepared_parts, "BLOCK", 2)
    monkeypatch.setattr(prepared, "ROWS", 5)
    agent, skill = agent_and_skill(world_model, *request.param)
    return PlannedAgent(agent, skill), PreparedAgent(agent, skill, th.float32)


def test_same_states_and_scores(agents):
    plain, ready = agents
    rssm = plain.agent.world_model.rssm
    starts = [LatentState(th.randn(N * M, rssm.stoch_size), th.randn(N * M, rssm.deter_size)) for _ in range(2)]
    check_states_and_scores(plain, ready, starts)


def test_short_products_stay_close(world_model):
    agent = Agent(world_model(), [8, 8], None)
    check_short_products(lambda dtype: PreparedAgent(agent, th.zeros(1, 0), dtype), agent.world_model.rssm.initial(M))


def test_extreme_logits_are_drawn(world_model):
    """One class far above the others, by more than exp can hold."""
    agent = Agent(world_model(), [8], None)
    rssm = agent.world_model.rssm
    with th.no_grad():
        rssm.prior_logits.weight.zero_()
        rssm.prior_logits.bias.view(rssm.logits_shape)[:, 2] = 1000.0
        ready = PreparedAgent(agent, th.zeros(1, 0), th.float32)
        state = ready.step(rssm.initial(M), th.zeros(M, 2), None)
    assert th.equal(state.classes, (th.arange(0, rssm.stoch_size, 4) + 2).expand(M, -1))


def test_which_form_and_format(world_model):
    agent, skill = Agent(world_model(), [8], None), th.zeros(1, 0)
    assert type(planned(agent, skill)) is PreparedAgent
    assert type(planned(agent, skill.to("meta"))) is PlannedAgent
    assert planned(agent, skill)._reward.rows.dtype == th.float32
    with th.autocast("cpu", th.bfloat16):
        assert planned(agent, skill)._reward.rows.dtype == th.bfloat16


@pytest.mark.parametrize("bias", [None, th.randn(3)], ids=["no bias", "bias"])
def test_prepacked_is_a_linear_layer_in_each_format(bias):
    weight, x, plus = th.randn(3, 7), th.randn(5, 7), th.randn(5, 3)
    expected = th.nn.functional.linear(x, weight, bias)
    layer = prepacked.PrepackedLinear(weight, bias, th.float32)
    assert layer.packed is None
    assert th.equal(layer(x), expected) and th.allclose(layer(x, plus), expected + plus)
    short = prepacked.PrepackedLinear(weight, bias, th.bfloat16)
    assert (short.packed is not None) == prepacked.cpu_multiplies_short()
    assert th.allclose(short(x.bfloat16()).float(), expected, atol=0.1)
    assert th.allclose(short(x.bfloat16(), plus.bfloat16()).float(), expected + plus, atol=0.1)


# -- draws with the first dimension innermost ------------------------------------------------------------------------------


def test_draws_invert_the_same_distribution():
    probs = th.rand(3, 4, 50)  # (S, K, n)
    uniform = th.rand((3, 50), generator=th.Generator().manual_seed(5))
    drawn = distributions.draw_classes(probs.movedim(-1, 0), th.Generator().manual_seed(5))
    cdf = probs.cumsum(1)
    expected = (cdf <= (uniform * cdf[:, -1]).unsqueeze(1)).sum(1)
    assert drawn.shape == (50, 3) and drawn.dtype == th.int64
    assert th.equal(drawn, expected.T) and expected.unique().tolist() == [0, 1, 2, 3]


def test_a_draw_leaves_the_probabilities_alone_and_never_runs_over():
    probs = th.rand(2, 4, 5).movedim(-1, 0)
    before = probs.clone()
    distributions.draw_classes(probs)
    assert th.equal(probs, before)
    # A uniform number that rounds to the whole sum.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(th.Tensor, "uniform_", lambda self, generator=None: self.fill_(1.0))
        assert (distributions.draw_classes(probs) == 3).all()
