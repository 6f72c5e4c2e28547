"""Stable-Baselines3-style DreamerV2 and DrQ-v2 for the Unsupervised RL Benchmark, from pixels.

Importing the package registers the environments ``urlb/<domain>-<task>-v0``. The public names load on first use, so that
who only wants an environment does not wait for torch, and the command line can still choose how torch's threads wait.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from sb3_dreamer_urlb._moved import keep_old_names
from sb3_dreamer_urlb.envs import register_envs
from sb3_dreamer_urlb.version import __version__

if TYPE_CHECKING:
    from sb3_dreamer_urlb.callbacks.checkpoint import RunCheckpointCallback
    from sb3_dreamer_urlb.callbacks.evaluation import EvaluationCallback
    from sb3_dreamer_urlb.callbacks.phase_switch import FineTuneCallback, PhaseSwitchCallback
    from sb3_dreamer_urlb.callbacks.snapshot import SnapshotCallback
    from sb3_dreamer_urlb.callbacks.videos import VideoCallback
    from sb3_dreamer_urlb.dreamer_v2 import DreamerV2
    from sb3_dreamer_urlb.dreamer_v2.policies import CnnPolicy, DreamerPolicy
    from sb3_dreamer_urlb.drq_v2 import DrQv2
    from sb3_dreamer_urlb.intrinsic import IntrinsicReward, register_intrinsic_reward
    from sb3_dreamer_urlb.learning.numerical_faults import NumericalFaultError
    from sb3_dreamer_urlb.planning import Planner, PlannerConfig, register_planner
    from sb3_dreamer_urlb.replay import SequenceReplayBuffer
    from sb3_dreamer_urlb.snapshots import SnapshotError

_MODULES = {
    "CnnPolicy": "dreamer_v2.policies",
    "DreamerPolicy": "dreamer_v2.policies",
    "DreamerV2": "dreamer_v2",
    "DrQv2": "drq_v2",
    "EvaluationCallback": "callbacks.evaluation",
    "FineTuneCallback": "callbacks.phase_switch",
    "IntrinsicReward": "intrinsic",
    "NumericalFaultError": "learning.numerical_faults",
    "PhaseSwitchCallback": "callbacks.phase_switch",
    "Planner": "planning",
    "PlannerConfig": "planning",
    "RunCheckpointCallback": "callbacks.checkpoint",
    "SequenceReplayBuffer": "replay",
    "SnapshotCallback": "callbacks.snapshot",
    "SnapshotError": "snapshots",
    "VideoCallback": "callbacks.videos",
    "register_intrinsic_reward": "intrinsic",
    "register_planner": "planning",
}

__all__ = [
    "CnnPolicy",
    "DrQv2",
    "DreamerPolicy",
    "DreamerV2",
    "EvaluationCallback",
    "FineTuneCallback",
    "IntrinsicReward",
    "NumericalFaultError",
    "PhaseSwitchCallback",
    "Planner",
    "PlannerConfig",
    "RunCheckpointCallback",
    "SequenceReplayBuffer",
    "SnapshotCallback",
    "SnapshotError",
    "VideoCallback",
    "register_envs",
    "register_intrinsic_reward",
    "register_planner",
]

register_envs()
keep_old_names()


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
