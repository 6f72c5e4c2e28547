"""Keep or drop the pre-trained actor: a short measurement in place of the paper's list of domains. The criterion is ours."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch as th
from stable_baselines3.common.type_aliases import GymEnv

from sb3_dreamer_urlb.analysis.trajectories import check_has_model
from sb3_dreamer_urlb.evaluation.episodes import run_evaluation
from sb3_dreamer_urlb.phases import PRETRAINING

if TYPE_CHECKING:
    from sb3_dreamer_urlb.dreamer_v2 import DreamerV2

#: enough to tell a dense task from a sparse one: 10k frames with both actors
EPISODES = 5
SEED = 3000


@dataclass(frozen=True)
class ActorTrial:
    """What the two actors that a fine-tuning may begin with find.

    :param pretrained: returns of the pre-trained actor, one an episode
    :param fresh: likewise of one that has learnt nothing
    :param frames: environment frames that this took, of the task
    """

    pretrained: tuple[float, ...]
    fresh: tuple[float, ...]
    frames: int

    @property
    def keep(self) -> bool:
        """Whether the pre-trained actor finds more reward. Where neither finds any, it is dropped: the task is sparse."""
        return float(np.mean(self.pretrained)) > float(np.mean(self.fresh))


def try_actor(model: DreamerV2, env: GymEnv | str, episodes: int = EPISODES, seed: int = SEED) -> ActorTrial:
    """Play the task with the pre-trained actor and with a fresh one, both exploring as fine-tuning would.

    ``model.fine_tune(env, keep_actor=try_actor(model, env).keep)``. The model stays as it is.

    :param model: pre-trained
    :param env: of the task, vectorised or not, or its id
    :param episodes: with each actor; the same ones
    :param seed: of the first
    :raises ValueError: for a model that is not pre-training, or whose actor has never learnt
    """
    check_has_model(model)
    if model.phase != PRETRAINING:
        raise ValueError(f"There is an actor to keep in the phase {PRETRAINING!r} only, this model is in {model.phase!r}.")
    if model.policy.agent.acts_randomly():
        raise ValueError(f"There is no actor to keep: intrinsic_reward={model.intrinsic_reward!r} trains none.")
    played = [run_evaluation(model, env, episodes, seed, "off", deterministic=False)]
    with _fresh_actor(model, seed):
        played.append(run_evaluation(model, env, episodes, seed, "off", deterministic=False))
    frames = model.action_repeat * sum(sum(one.lengths) for one in played)
    return ActorTrial(tuple(played[0].returns), tuple(played[1].returns), frames)


@contextmanager
def _fresh_actor(model: DreamerV2, seed: int) -> Iterator[None]:
    actor = model.policy.agent.actor
    learnt = copy.deepcopy(actor.state_dict())
    with th.random.fork_rng(devices=[]):
        th.manual_seed(seed)
        fresh = model._new_policy().agent.actor.state_dict()
    actor.load_state_dict(fresh)
    try:
        yield
    finally:
        actor.load_state_dict(learnt)
