"""Planners that act through ``predict()``."""

from sb3_dreamer_urlb.planning.base import Planner
from sb3_dreamer_urlb.planning.categorical import CategoricalDynaMPC
from sb3_dreamer_urlb.planning.config import PlannableModel, PlannerConfig
from sb3_dreamer_urlb.planning.dyna_mpc import DynaMPC
from sb3_dreamer_urlb.planning.registry import PLANNERS, make_planner, planner_name, register_planner, registered_planners

__all__ = [
    "PLANNERS",
    "CategoricalDynaMPC",
    "DynaMPC",
    "PlannableModel",
    "Planner",
    "PlannerConfig",
    "make_planner",
    "planner_name",
    "register_planner",
    "registered_planners",
]

register_planner("dyna_mpc", DynaMPC, CategoricalDynaMPC)
# MPPI trusts rewards only: no critic, no actor proposals.
register_planner("mppi", DynaMPC, CategoricalDynaMPC, settled={"use_value": False, "mixture": 0.0})
# The paper's zero-shot study: looks further, with more trajectories (appendix "Zero-shot Adaptation").
register_planner(
    "mppi_zero_shot",
    DynaMPC,
    CategoricalDynaMPC,
    settled={"use_value": False, "mixture": 0.0, "n_samples": 1000, "top_k": 100, "horizon": 15},
)
