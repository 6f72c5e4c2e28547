"""Intrinsic rewards: one short file a method, one line here each."""

from sb3_dreamer_urlb.intrinsic.base import (
    IntrinsicReward,
    RewardSource,
    TaskReward,
    get_intrinsic_reward,
    register_intrinsic_reward,
    registered_intrinsic_rewards,
)
from sb3_dreamer_urlb.intrinsic.lbs import LBS

register_intrinsic_reward("lbs", LBS)

__all__ = [
    "LBS",
    "IntrinsicReward",
    "RewardSource",
    "TaskReward",
    "get_intrinsic_reward",
    "register_intrinsic_reward",
    "registered_intrinsic_rewards",
]
