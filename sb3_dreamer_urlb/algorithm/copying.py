"""Copying the parts of a pre-trained agent that a table keeps into a fine-tuning one."""

from __future__ import annotations

from collections.abc import Mapping

from torch import nn

from sb3_dreamer_urlb.transfer_rule import ACTOR_CHOICE, CRITIC_CHOICE, FRESH, KEPT


def copy_kept(source: nn.Module, target: nn.Module, table: Mapping[str, str], keep_actor: bool, keep_critic: bool) -> None:
    """Copy what a table keeps from one agent into a fresh one of the same sizes.

    :param source: pre-trained
    :param target: fresh; changed in place
    :param table: from the name of a part to what becomes of it, see ``transfer_rule.py``
    :param keep_actor: whether ``ACTOR_CHOICE`` is kept
    :param keep_critic: whether ``CRITIC_CHOICE`` is kept
    """
    kept = {KEPT: True, ACTOR_CHOICE: keep_actor, CRITIC_CHOICE: keep_critic, FRESH: False}
    parts = tuple(f"{name}." for name, rule in table.items() if kept[rule])
    state = {name: value for name, value in source.state_dict().items() if name.startswith(parts)}
    target.load_state_dict(state, strict=False)
