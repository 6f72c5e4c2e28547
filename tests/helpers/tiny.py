"""Sizes and numbers of the tiny agents of the tests, and what is done with them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch as th

from sb3_dreamer_urlb.types import Posterior, SequenceBatch
from sb3_dreamer_urlb.world_model.world_model import WorldModel

IMAGE, ACTIONS = (3, 16, 16), 2
LEARNER = {
    "learning_rate": 1e-3,
    "actor_learning_rate": 1e-3,
    "critic_learning_rate": 1e-3,
    "adam_eps": 1e-5,
    "max_grad_norm": 100.0,
    "weight_decay": 1e-6,
    "free_nats": 0.0,
    "kl_balance": 0.8,
    "imagination_horizon": 3,
    "gae_lambda": 0.95,
    "target_update_interval": 100,
    "ent_coef": 0.0,
    "reward_trains_model": True,
}


@contextmanager
def threads_of(count: int) -> Iterator[None]:
    """Inside, torch and kernels of our own use so many threads."""
    before = th.get_num_threads()
    th.set_num_threads(count)
    try:
        yield
    finally:
        th.set_num_threads(before)


def infer(model: WorldModel, batch: SequenceBatch) -> Posterior:
    """What a world model infers about a batch, with its graph."""
    return model.observe(model.preprocess(batch.observation), batch.action, batch.is_first)
