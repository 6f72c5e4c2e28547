"""How far apart two predictions of the same latent state are."""

from __future__ import annotations

import torch as th


def jensen_shannon(logits: th.Tensor, other: th.Tensor) -> th.Tensor:
    """Symmetric Jensen–Shannon divergence ½ KL(p ‖ m) + ½ KL(q ‖ m), m = ½ (p + q), of categoricals, in nats.

    0 for equal distributions, ln 2 for disjoint ones.

    :param logits: of p, float (…, K); −inf for what never happens
    :param other: of q, float (…, K)
    :return: float64 (…)
    """
    log_p, log_q = logits.double().log_softmax(-1), other.double().log_softmax(-1)
    return 0.5 * (_to_the_middle(log_p, log_q) + _to_the_middle(log_q, log_p))


def _to_the_middle(log_p: th.Tensor, log_q: th.Tensor) -> th.Tensor:
    """KL(p ‖ m) = Σ p · (ln 2 − ln(1 + q/p)): exactly 0 where p = q."""
    zero = th.zeros_like(log_p)
    # 0 · ln 0 is 0.
    never = log_p == -th.inf
    apart = th.where(never, -th.inf, log_q - log_p.masked_fill(never, 0.0))
    return (log_p.exp() * (th.logaddexp(zero, zero) - th.logaddexp(zero, apart))).sum(-1)
