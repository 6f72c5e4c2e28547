"""The two phases of the benchmark: what distinguishes them (paper §2 "Unsupervised RL")."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sb3_dreamer_urlb._moved import names_that_moved


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


# Until version 0.3.
__getattr__ = names_that_moved("phases")
