"""Which parts move from a pre-trained DreamerV2 agent into a fine-tuning one (paper §3 "Task-aware fine-tuning")."""

from __future__ import annotations

from sb3_dreamer_urlb.agent import Agent
from sb3_dreamer_urlb.algorithm.copying import copy_kept
from sb3_dreamer_urlb.nn.nets import MLP
from sb3_dreamer_urlb.transfer_rule import ACTOR_CHOICE, CRITIC_CHOICE, FRESH, KEPT

#: What a fine-tuning takes over from the pre-trained agent (docs/algorithm.md, "Transfer"). Optimisers and replay always
#: stay behind, and so does an intrinsic reward without skills: nothing in a fine-tuning agent would take it.
TRANSFER: dict[str, str] = {
    "world_model.encoder": KEPT,
    "world_model.rssm": KEPT,
    "world_model.decoder": KEPT,
    "world_model.discount_logit": KEPT,
    "world_model.reward": FRESH,
    "actor": ACTOR_CHOICE,
    "critic": CRITIC_CHOICE,
    "slow_critic": CRITIC_CHOICE,
    "reward_normalizer": FRESH,
    # The skills of DIAYN and APS, and what APS chooses one by (docs/algorithm.md, "Skills").
    "intrinsic": KEPT,
}

#: replayed states by which DIAYN and APS choose the skill for a task (docs/algorithm.md, "Skills")
SKILL_STATES = 4096


def transfer(source: Agent, target: Agent, keep_actor: bool, keep_critic: bool, known_reward: MLP | None = None) -> None:
    """Copy what ``TRANSFER`` keeps from one agent into a fresh one of the same sizes; the task's reward head if it is known.

    :param source: pre-trained
    :param target: fresh; changed in place
    :param keep_actor: see ``TRANSFER``
    :param keep_critic: see ``TRANSFER``
    :param known_reward: begin with this reward head, the source's of the task
    """
    copy_kept(source, target, TRANSFER, keep_actor, keep_critic)
    if known_reward is not None:
        target.world_model.reward.load_state_dict(known_reward.state_dict())
