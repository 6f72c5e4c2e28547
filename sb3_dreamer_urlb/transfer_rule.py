"""What a fine-tuning takes over: the rule that decides on the actor, and what a table of an agent's parts may say.

Paper §3 "Task-aware fine-tuning". Each algorithm has its table in ``kept_parts.py``.
"""

from __future__ import annotations

#: Domains whose tasks give reward only in small regions: the pre-trained actor would drive away from them.
SPARSE_DOMAINS = ("jaco",)

#: what may become of a part
KEPT, ACTOR_CHOICE, CRITIC_CHOICE, FRESH = "kept", "kept if keep_actor", "kept if keep_critic", "fresh"


def keeps_actor(domain: str | None) -> bool:
    """The paper's task-aware rule: keep the actor where rewards are dense, drop it where they are sparse.

    :param domain: of the fine-tuning task; None for an environment that does not tell, which counts as dense
    """
    return domain not in SPARSE_DOMAINS
