"""What a pre-trained agent is shown of the same state must stay the same in fine-tuning: VecNormalize's statistics."""

from __future__ import annotations

import copy

from stable_baselines3.common.vec_env import VecNormalize


def _how(normalizer: VecNormalize | None) -> dict[str, object] | None:
    """How observations are normalised, statistics aside; None if they are not."""
    if normalizer is None or not normalizer.norm_obs:
        return None
    return {name: getattr(normalizer, name) for name in ("norm_obs_keys", "clip_obs", "epsilon")}


def check(before: VecNormalize | None, after: VecNormalize | None) -> None:
    """Whether observations are normalised alike.

    :param before: of the pre-training's environment, None without
    :param after: of the fine-tuning's, None without
    :raises ValueError: if they are not; says what to do
    """
    mine, its = _how(before), _how(after)
    if mine == its:
        return
    texts = ["as they are" if how is None else f"through VecNormalize({how})" for how in (mine, its)]
    raise ValueError(
        f"The agent was pre-trained on observations {texts[0]}, the fine-tuning environment shows them {texts[1]}: "
        "it would see other numbers for the same state. Wrap the environment as the pre-training's was; the statistics are "
        "carried over."
    )


def carry_over(before: VecNormalize | None, after: VecNormalize | None) -> None:
    """Give the statistics of observations to another environment; those of rewards are the task's own.

    :param before: whose
    :param after: changed in place
    """
    if before is not None and after is not None and before is not after and after.norm_obs:
        after.obs_rms = copy.deepcopy(before.obs_rms)
