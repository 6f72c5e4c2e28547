"""The KL of the world model's loss: how it is shared between prior and posterior (docs/algorithm.md, "World model")."""

from __future__ import annotations

import torch as th

from sb3_dreamer_urlb.nn import distributions


def balanced_kl(post_logits: th.Tensor, prior_logits: th.Tensor, free_nats: float, kl_balance: float) -> th.Tensor:
    """The KL from posterior to prior, a scalar, with its gradient shared between the two.

    :param post_logits: (B, T, S, K)
    :param prior_logits: likewise
    :param free_nats: below which the mean over the batch is not pushed
    :param kl_balance: share of the gradient that trains the prior
    """
    train_post = distributions.categorical_kl(post_logits, prior_logits.detach()).mean()
    train_prior = distributions.categorical_kl(post_logits.detach(), prior_logits).mean()
    return (1 - kl_balance) * train_post.clamp(min=free_nats) + kl_balance * train_prior.clamp(min=free_nats)
