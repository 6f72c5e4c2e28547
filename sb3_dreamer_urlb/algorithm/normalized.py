"""What a trained agent is shown of the same state must stay the same when it goes on: VecNormalize's statistics."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Mapping

import torch as th
from stable_baselines3.common.vec_env import VecNormalize

from sb3_dreamer_urlb.snapshots import normalization


def _how(normalizer: VecNormalize | None) -> dict[str, object] | None:
    """How observations are normalised, statistics aside; None if they are not."""
    if normalizer is None or not normalizer.norm_obs:
        return None
    return {name: getattr(normalizer, name) for name in ("norm_obs_keys", *normalization.OF_OBSERVATIONS)}


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


def go_on(known: Mapping[str, th.Tensor], after: VecNormalize | None) -> None:
    """Let an agent that has learnt go on in another environment.

    A VecNormalize that has seen nothing takes the statistics over. Warns where the agent would see other numbers for the same
    state.

    :param known: statistics and settings of the VecNormalize that it learnt behind, empty without
    :param after: of the environment, None without; changed in place
    """
    seen = normalization.of_observations(known)
    its = normalization.of_observations(normalization.pack(after))
    if after is None or not its:
        if seen:
            warnings.warn(
                "The model has learnt from observations behind VecNormalize, this environment shows them as they are: it "
                "would see other numbers for the same state. Wrap it in VecNormalize, which takes the statistics over."
            )
        return
    if seen and (texts := normalization.differing(known, after, normalization.OF_OBSERVATIONS)):
        warnings.warn(
            f"The model has learnt from observations through VecNormalize({texts[0]}), this environment has "
            f"VecNormalize({texts[1]}): it would see other numbers for the same state."
        )
    if not _has_seen_nothing(after):
        return
    if {name: value.shape for name, value in seen.items()} == {name: value.shape for name, value in its.items()}:
        normalization.put(after, seen)
    else:
        what = "of other observations" if seen else "that its file knows nothing of"
        warnings.warn(
            f"The model goes on behind a VecNormalize {what}, which has seen nothing yet: it would see other numbers for the "
            "same state. Load the statistics that it learnt with: VecNormalize.load."
        )


def warn_of_rewards(known: Mapping[str, th.Tensor], after: VecNormalize | None) -> None:
    """Warn where a critic would go on with rewards of another scale.

    :param known: as :func:`go_on`
    :param after: likewise
    """
    before = normalization.stored_settings(known)
    if after is None and before.get("norm_reward"):
        texts: tuple[str, str] | None = ("norm_reward=1", "none")
    elif after is None or not (after.norm_reward or before.get("norm_reward")):
        texts = None
    else:
        texts = normalization.differing(known, after, normalization.OF_REWARDS)
    if texts is not None:
        warnings.warn(
            f"The model has learnt from rewards through VecNormalize({texts[0]}), this environment has "
            f"{'none' if after is None else f'VecNormalize({texts[1]})'}: what its critic knows is of another scale."
        )


def _has_seen_nothing(normalizer: VecNormalize) -> bool:
    """Or a reset at most."""
    seen = [part.count for name, part in normalization.statistics(normalizer).items() if name != normalization.RETURN]
    return max(seen) < normalizer.num_envs + 1
