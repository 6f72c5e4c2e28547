"""A Stable-Baselines3-style DreamerV2 for the Unsupervised RL Benchmark, from pixels.

Importing the package registers the environments ``urlb/<domain>-<task>-v0``.
"""

from pathlib import Path

from sb3_dreamer_urlb.dreamer_v2 import DreamerV2
from sb3_dreamer_urlb.envs import register_envs
from sb3_dreamer_urlb.intrinsic import IntrinsicReward, register_intrinsic_reward
from sb3_dreamer_urlb.phases import PhaseSwitchCallback, SnapshotCallback
from sb3_dreamer_urlb.planning import PlannerConfig
from sb3_dreamer_urlb.policies import CnnPolicy, DreamerPolicy
from sb3_dreamer_urlb.replay import SequenceReplayBuffer

register_envs()

__version__ = Path(__file__).with_name("version.txt").read_text().strip()

__all__ = [
    "CnnPolicy",
    "DreamerPolicy",
    "DreamerV2",
    "IntrinsicReward",
    "PhaseSwitchCallback",
    "PlannerConfig",
    "SequenceReplayBuffer",
    "SnapshotCallback",
    "register_envs",
    "register_intrinsic_reward",
]
