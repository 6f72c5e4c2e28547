"""Planning alone: the pre-trained model and a known reward, without or with fine-tuning (paper, appendix "Zero-shot")."""

from __future__ import annotations

from typing import TYPE_CHECKING

from sb3_dreamer_urlb.analysis.trajectories import check_has_model
from sb3_dreamer_urlb.number_checks import check_integer
from sb3_dreamer_urlb.phases import PRETRAINING

if TYPE_CHECKING:
    from sb3_dreamer_urlb.dreamer_v2 import DreamerV2

#: the paper's: no actor, no critic, 1000 trajectories of 15 steps, 100 elites
PLANNER = "mppi_zero_shot"


def check_pretrained(model: DreamerV2) -> None:
    """
    :param model: that is to plan at once
    :raises ValueError: unless it is a pre-trained world model that knows the task's reward
    """
    check_has_model(model)
    if model.phase != PRETRAINING:
        raise ValueError(f"Zero-shot planning needs a pre-trained snapshot, this one is in the phase {model.phase!r}.")
    model._check_reward_is_known(model.get_env())


def prepare_zero_shot(model: DreamerV2, finetune_frames: int = 0) -> DreamerV2:
    """Make a pre-trained model plan with its model and its reward head only; evaluate it with ``planner="on"``.

    :param model: loaded with ``planner="mppi_zero_shot"``; with ``freeze_decoder=True`` for the latent dynamics discrepancy
    :param finetune_frames: environment frames of fine-tuning first, in the model's environment, by the same planner; neither
        actor nor critic learn
    :raises ValueError: for a model without a known reward or without a planner; it is as it was then
    """
    check_integer("finetune_frames", finetune_frames, 0)
    check_pretrained(model)
    if model.policy.planner is None:
        raise ValueError(f"Zero-shot planning needs a planner: DreamerV2.load(snapshot, planner={PLANNER!r}).")
    model.fine_tune(keep_actor=False, keep_reward=True)
    if finetune_frames:
        model.learn(finetune_frames // model.action_repeat)
    return model
