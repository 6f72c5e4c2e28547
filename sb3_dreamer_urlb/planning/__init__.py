"""Planners that act through ``predict()``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sb3_dreamer_urlb.planning.categorical import CategoricalDynaMPC
from sb3_dreamer_urlb.planning.dyna_mpc import DynaMPC, PlannableModel, PlannerConfig

#: What each planner's name settles in the configuration, whatever preset or user say about these fields. MPPI trusts
#: rewards only: no critic, no actor proposals.
PLANNERS: dict[str, dict[str, Any]] = {"dyna_mpc": {}, "mppi": {"use_value": False, "mixture": 0.0}}


def make_planner(
    name: str | None, kwargs: dict[str, Any] | None, gae_lambda: float, classes: Sequence[int] = ()
) -> DynaMPC | None:
    """Build the planner that a user asked for.

    :param name: a key of ``PLANNERS``, or None to act with the actor
    :param kwargs: fields of :class:`PlannerConfig` to change; those that the name settles are ignored
    :param gae_lambda: λ of the critic
    :param classes: number of classes of each choice that is an action; empty where actions are numbers
    :raises ValueError: for an unknown name, an unknown field or a value out of range
    """
    if name is not None and name not in PLANNERS:
        raise ValueError(f"Unknown planner {name!r}; known are {sorted(PLANNERS)} and None for the actor.")
    fields = {**(kwargs or {}), **PLANNERS.get(name or "", {})}
    unknown = sorted(set(fields) - set(PlannerConfig.__dataclass_fields__))
    if unknown:
        raise ValueError(f"Unknown planner_kwargs {unknown}; known are {sorted(PlannerConfig.__dataclass_fields__)}.")
    config = PlannerConfig(**fields)
    if name is None:
        return None
    return CategoricalDynaMPC(config, gae_lambda, classes) if classes else DynaMPC(config, gae_lambda)


__all__ = ["PLANNERS", "CategoricalDynaMPC", "DynaMPC", "PlannableModel", "PlannerConfig", "make_planner"]
