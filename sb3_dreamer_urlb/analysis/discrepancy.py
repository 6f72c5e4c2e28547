"""Latent dynamics discrepancy: how much fine-tuning changed what the model predicts (paper, appendix of that name)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch as th

from sb3_dreamer_urlb.algorithm import normalized
from sb3_dreamer_urlb.analysis.divergence import jensen_shannon
from sb3_dreamer_urlb.analysis.trajectories import SEED, Trajectory, as_batch, check_fits, check_has_model
from sb3_dreamer_urlb.snapshots import normalization
from sb3_dreamer_urlb.types import LatentState

if TYPE_CHECKING:
    from sb3_dreamer_urlb.dreamer_v2 import DreamerV2
    from sb3_dreamer_urlb.world_model.rssm import RSSM


def latent_dynamics_discrepancy(
    pretrained: DreamerV2, finetuned: DreamerV2, trajectories: Sequence[Trajectory], seed: int = SEED
) -> list[float]:
    """LDD = E[D_JS(p_FT(z' | z, a) ‖ p_PT(z' | z, a))]: z from the fine-tuned posterior, a from the oracle.

    Both models predict from the same z, its recurrent part included: as the decoder was frozen, it stands for the same
    picture in both. The divergence is the mean over the categoricals, so it lies between 0 and ln 2.

    :param pretrained: before the fine-tuning
    :param finetuned: after it, with ``freeze_decoder=True``
    :param trajectories: of an oracle
    :param seed: of the posterior's samples
    :return: mean over the steps of each trajectory, nats per categorical
    :raises ValueError: for models that cannot be compared, or trajectories that they cannot follow
    """
    check_comparable(pretrained, finetuned)
    check_fits(finetuned, trajectories)
    model = finetuned.policy.agent.world_model
    before, after = pretrained.policy.agent.world_model.rssm, model.rssm
    found = []
    device = finetuned.device
    with th.no_grad(), th.random.fork_rng([device] if device.type == "cuda" else []):
        th.manual_seed(seed)
        for trajectory in trajectories:
            batch = as_batch(finetuned.policy, trajectory, finetuned.get_vec_normalize_env())
            posterior = model.observe(model.preprocess(batch.observation), batch.action, batch.is_first)
            state = LatentState(posterior.state.stoch[0, :-1], posterior.state.deter[0, :-1])
            found.append(float(_divergence(before, after, state, batch.action[0, 1:]).mean()))
    return found


def _divergence(before: RSSM, after: RSSM, state: LatentState, action: th.Tensor) -> th.Tensor:
    """Of each next state and variable, float64 (n, S)."""
    return jensen_shannon(after.predict_logits(state, action), before.predict_logits(state, action))


def check_comparable(pretrained: DreamerV2, finetuned: DreamerV2) -> None:
    """
    :param pretrained: before the fine-tuning
    :param finetuned: after it
    :raises ValueError: naming what differs: spaces, domain, sizes, statistics of observations; or a decoder that was not
        frozen
    """
    for model in (pretrained, finetuned):
        check_has_model(model)
    for name in ("observation_space", "action_space", "domain"):
        one, other = getattr(pretrained, name), getattr(finetuned, name)
        if one != other:
            raise ValueError(f"The two models differ in {name}: {one} before fine-tuning, {other} after it.")
    if finetuned.device != pretrained.device:
        raise ValueError(f"The two models are on {pretrained.device} and {finetuned.device}: load both on one.")
    parts = [model.policy.agent.world_model.state_dict() for model in (pretrained, finetuned)]
    shapes = [{name: tuple(value.shape) for name, value in part.items()} for part in parts]
    if shapes[0] != shapes[1]:
        name = next(n for n in sorted({*shapes[0], *shapes[1]}) if shapes[0].get(n) != shapes[1].get(n))
        raise ValueError(
            f"The two models are of different sizes: {name} is {shapes[0].get(name)} before, {shapes[1].get(name)} after."
        )
    if not all(th.equal(value, parts[1][name]) for name, value in parts[0].items() if name.startswith("decoder.")):
        raise ValueError(
            "The decoders differ, so a latent state means something else to each: either the second agent does not come from "
            "this pre-training, or its decoder was not frozen. Fine-tune this very snapshot with DreamerV2.load(snapshot, "
            "freeze_decoder=True)."
        )
    _check_normalized_alike(pretrained, finetuned)


def _check_normalized_alike(pretrained: DreamerV2, finetuned: DreamerV2) -> None:
    before, after = pretrained.get_vec_normalize_env(), finetuned.get_vec_normalize_env()
    normalized.check(before, after)
    one, other = normalization.pack(before), normalization.pack(after)
    seen = [name for name in one if name.startswith(f"{normalization.PREFIX}{normalization.OBSERVATION}")]
    if not all(th.equal(one[name], other[name]) for name in seen):
        raise ValueError(
            "VecNormalize's statistics of observations moved in fine-tuning, so a latent state means something else after it "
            "than before: fine-tune in a VecNormalize(training=False) with those of the pre-training."
        )
