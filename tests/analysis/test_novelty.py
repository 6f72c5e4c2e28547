"""Intrinsic reward along the trajectories of an oracle."""

from __future__ import annotations

import pytest
import torch as th
from counter_task import ENV
from stable_baselines3.common.env_util import make_vec_env

from sb3_dreamer_urlb import DreamerV2
from sb3_dreamer_urlb.analysis.novelty import intrinsic_reward_on
from sb3_dreamer_urlb.analysis.trajectories import as_batch, play_trajectories


@pytest.fixture
def trajectories(tuned):
    return play_trajectories(DreamerV2.load(tuned, device="cpu"), make_vec_env(ENV, 1), 2)


@pytest.mark.parametrize("method", ["lbs", "icm", "rnd", "plan2explore", "diayn"])
def test_by_hand(snapshots, trajectories, weights, method):
    model = DreamerV2.load(snapshots(method), device="cpu")
    before = weights(model.policy)
    found = intrinsic_reward_on(model, trajectories[:1], seed=3)
    assert weights(model.policy) == before
    agent = model.policy.agent
    batch = as_batch(model.policy, trajectories[0])
    th.manual_seed(3)
    with th.no_grad():
        posterior = agent.world_model.observe(agent.world_model.preprocess(batch.observation), batch.action, batch.is_first)
        feature, action = posterior.feature[0], batch.action[0]
        method_of = agent.intrinsic
        if method == "lbs":
            expected = method_of.surprise(feature)[1:]
        elif method == "icm":
            predicted = method_of.forward_model(th.cat([posterior.embed[0, :-1], action[1:]], -1))
            expected = (1 + (predicted - posterior.embed[0, 1:]).norm(dim=-1)).log()
        elif method == "diayn":
            skill = agent.skills.sample(1).expand(len(feature), -1)
            expected = (method_of.discriminator(feature).log_softmax(-1) * skill).sum(-1)[1:] + th.log(th.tensor(50.0))
        else:
            assert len(found) == 1 and found[0] > 0
            return
    assert found == pytest.approx([expected.mean().item()], rel=1e-4)


def test_the_order_of_the_trajectories_does_not_matter(snapshots, trajectories):
    """RND's running deviation begins anew for each; the observations alone decide."""
    model = DreamerV2.load(snapshots("rnd"), device="cpu")
    forwards, backwards = (intrinsic_reward_on(model, order) for order in (trajectories, trajectories[::-1]))
    assert forwards == pytest.approx(backwards[::-1], rel=1e-6)


def test_who_has_no_intrinsic_reward_is_refused(snapshots, tuned, trajectories):
    with pytest.raises(ValueError, match="explores without a reward"):
        intrinsic_reward_on(DreamerV2.load(snapshots("random"), device="cpu"), trajectories)
    with pytest.raises(ValueError, match="this one is in 'finetuning'"):
        intrinsic_reward_on(DreamerV2.load(tuned, device="cpu"), trajectories)
