"""Which parts move from a pre-trained DrQ-v2 agent into a fine-tuning one, as in the benchmark (URLB, Laskin et al., 2021)."""

from __future__ import annotations

from sb3_dreamer_urlb.algorithm.copying import copy_kept
from sb3_dreamer_urlb.drq_v2.agent import DrQAgent
from sb3_dreamer_urlb.transfer_rule import ACTOR_CHOICE, CRITIC_CHOICE, FRESH, KEPT

#: What a fine-tuning takes over from the pre-trained agent. Optimisers and replay always stay behind.
TRANSFER: dict[str, str] = {
    "encoder": KEPT,
    "actor": ACTOR_CHOICE,
    "critic.trunk": KEPT,
    "critic.heads": CRITIC_CHOICE,
    "target_critic": FRESH,
    "intrinsic": FRESH,
}


def transfer(source: DrQAgent, target: DrQAgent, keep_actor: bool, keep_critic: bool) -> None:
    """Copy what ``TRANSFER`` keeps; the target critic begins as a copy of the critic, as in every run.

    :param source: pre-trained
    :param target: fresh; changed in place
    :param keep_actor: see ``TRANSFER``
    :param keep_critic: see ``TRANSFER``
    """
    copy_kept(source, target, TRANSFER, keep_actor, keep_critic)
    target.target_critic.load_state_dict(target.critic.state_dict())
