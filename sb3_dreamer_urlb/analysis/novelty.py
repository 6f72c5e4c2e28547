"""How interesting a pre-trained agent finds what an oracle does (paper, appendix "Unsupervised Rewards and Performance")."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch as th

from sb3_dreamer_urlb.analysis.trajectories import SEED, Trajectory, as_batch, check_fits, check_has_model
from sb3_dreamer_urlb.phases import PRETRAINING
from sb3_dreamer_urlb.types import Imagination

if TYPE_CHECKING:
    from sb3_dreamer_urlb.dreamer_v2 import DreamerV2


def intrinsic_reward_on(model: DreamerV2, trajectories: Sequence[Trajectory], seed: int = SEED) -> list[float]:
    """Mean intrinsic reward of the states of each trajectory but the first, which nothing led to.

    The reward is the one that the actor seeks, at the posterior states of the trajectory in place of imagined ones; for ICM
    and RND the one that their reward head learns, on the observations themselves. The reward normaliser does not divide it. A
    method with skills follows a random one for each trajectory. Running statistics begin with the snapshot's for every
    trajectory.

    :param model: pre-trained, not fine-tuned
    :param trajectories: of an oracle
    :param seed: of the posterior's samples, and of the skills
    :raises ValueError: for a model without an intrinsic reward, or trajectories that it cannot follow
    """
    check_has_intrinsic_reward(model)
    check_fits(model, trajectories)
    agent, found = model.policy.agent, []
    device = model.device
    with th.no_grad(), th.random.fork_rng([device] if device.type == "cuda" else []):
        th.manual_seed(seed)
        for trajectory in trajectories:
            source = copy.deepcopy(agent.intrinsic)
            assert source is not None
            batch = as_batch(model.policy, trajectory, model.get_vec_normalize_env())
            posterior = agent.world_model.observe(
                agent.world_model.preprocess(batch.observation), batch.action, batch.is_first
            )
            if source.labels_replay:
                reward = source.replay_reward(posterior, batch)[0]
            else:
                skill = None if agent.skills is None else agent.skills.sample(1)
                seen, action = posterior.feature.transpose(0, 1), batch.action.transpose(0, 1)
                dream = Imagination(seen, action, seen.new_zeros(len(seen) - 1, 1), skill)
                reward = source.reward(dream, agent.world_model.reward)[:, 0]
            found.append(float(reward[1:].mean()))
    return found


def check_has_intrinsic_reward(model: DreamerV2) -> None:
    """
    :param model: that is to be asked
    :raises ValueError: unless it is pre-training, with a method that rewards anything
    """
    check_has_model(model)
    if model.phase != PRETRAINING:
        raise ValueError(f"The intrinsic reward of a pre-trained snapshot is asked for, this one is in {model.phase!r}.")
    if model.policy.agent.acts_randomly():
        raise ValueError(f"intrinsic_reward={model.intrinsic_reward!r} explores without a reward.")
