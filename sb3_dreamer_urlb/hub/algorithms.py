"""Whose models can be shared, and what a reader is told about each kind."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sb3_dreamer_urlb.algorithm import PhasedAlgorithm
from sb3_dreamer_urlb.dreamer_v2 import DreamerV2
from sb3_dreamer_urlb.drq_v2 import DrQv2


@dataclass(frozen=True)
class SharedAlgorithm:
    """One of them.

    :param kind: its class
    :param zoo: what stands behind rl_zoo3's ``--algo``, and begins the names of its models
    :param tag: on the Hub
    :param about: a model of it, in a phrase
    """

    kind: type[PhasedAlgorithm]
    zoo: str
    tag: str
    about: str

    @property
    def name(self) -> str:
        """What is imported to load its models."""
        return self.kind.__name__


SHARED = (
    SharedAlgorithm(DreamerV2, "dreamerv2", "dreamer-v2", "A world model with an actor"),
    SharedAlgorithm(DrQv2, "drq_v2", "drq-v2", "An actor and a critic on encoded frames"),
)


def algorithm_of(model: Any) -> SharedAlgorithm:
    """
    :param model: what is to be shared
    :raises ValueError: for anything but a model of one of these algorithms
    """
    found = next((one for one in SHARED if isinstance(model, one.kind)), None)
    if found is None:
        names = " or ".join(one.name for one in SHARED)
        raise ValueError(f"A model of {names} can be shared, got {type(model).__name__}.")
    return found
