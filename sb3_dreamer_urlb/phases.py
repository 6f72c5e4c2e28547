"""The two phases of the benchmark: what distinguishes them (paper §2 "Unsupervised RL")."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from importlib import import_module
from typing import Any


@dataclass(frozen=True)
class Phase:
    """What distinguishes a phase; everything else of the algorithm is the same in both.

    :param explores: the intrinsic reward drives the actor, the task's reward does not reach the world model
    :param random_warmup: the steps before the first update act uniformly at random, otherwise with the actor
    :param plans: a planner, if one is set, acts
    :param ent_coef: entropy bonus of the actor; None takes the intrinsic reward's own
    """

    explores: bool
    random_warmup: bool
    plans: bool
    ent_coef: float | None


PRETRAINING, FINETUNING = "pretraining", "finetuning"
PHASES: dict[str, Phase] = {
    PRETRAINING: Phase(explores=True, random_warmup=True, plans=False, ent_coef=None),
    # Also a run from scratch, without pre-training: the paper's baseline.
    FINETUNING: Phase(explores=False, random_warmup=False, plans=True, ent_coef=1e-4),
}


def phase_ent_coef(phase: str, intrinsic: Any, chosen: float | None, preset: float | None = None) -> float:
    """The actor's entropy bonus: the user's, else an exploring reward's own, else the preset's, else the phase's.

    A reward that needs a bonus of its own (DIAYN) needs it whatever the size of the networks, so no preset replaces it.

    :param phase: a key of ``PHASES``
    :param intrinsic: the intrinsic reward, None without
    :param chosen: the user's
    :param preset: that of the preset, None where it has none
    """
    if chosen is not None:
        return chosen
    default = PHASES[phase].ent_coef
    if default is None:
        own: float = intrinsic.ent_coef
        if own > 0:
            return own
        default = own
    return default if preset is None else preset


def __getattr__(name: str) -> Any:
    # Until version 0.3: these lay here in version 0.1.
    moved = {
        **dict.fromkeys(("PhaseSwitchCallback", "FineTuneCallback"), "callbacks.phase_switch"),
        **dict.fromkeys(("SnapshotCallback", "SNAPSHOT_FRAMES"), "callbacks.snapshot"),
        **dict.fromkeys(("TRANSFER", "transfer"), "dreamer_v2.kept_parts"),
        **dict.fromkeys(("SPARSE_DOMAINS", "keeps_actor"), "transfer_rule"),
    }
    if name not in moved:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    new = f"sb3_dreamer_urlb.{moved[name]}"
    warnings.warn(
        f"{__name__}.{name} is now {new}.{name}; the old name ends with version 0.3.", DeprecationWarning, stacklevel=2
    )
    return getattr(import_module(new), name)
