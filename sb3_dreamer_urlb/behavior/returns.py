"""The λ-return (paper, equation 1)."""

from __future__ import annotations

import torch as th


def lambda_return(reward: th.Tensor, value: th.Tensor, discount: th.Tensor, gae_lambda: float) -> th.Tensor:
    """V_t = r_t + γ_t · ((1 − λ) · v_{t+1} + λ · V_{t+1}), bootstrapped with the last value.

    :param reward: r_0 … r_{H-1}, the reward *of* each state, float (H, …)
    :param value: v_0 … v_H; v_0 is not used, float (H + 1, …)
    :param discount: γ_0 … γ_{H-1}, float (H, …)
    :param gae_lambda: λ, the trade-off between bias (0) and variance (1)
    :return: V_0 … V_{H-1}, float (H, …)
    """
    one_step = reward + discount * (1 - gae_lambda) * value[1:]
    carry = discount * gae_lambda
    returns = [value[-1]]
    for t in reversed(range(reward.shape[0])):
        returns.append(one_step[t] + carry[t] * returns[-1])
    return th.stack(returns[:0:-1])
