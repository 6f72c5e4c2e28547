"""Intrinsic rewards: one short file a method, one line here each."""

from sb3_dreamer_urlb.intrinsic.aps import APS
from sb3_dreamer_urlb.intrinsic.apt import APT
from sb3_dreamer_urlb.intrinsic.base import IntrinsicReward, RewardHead, RewardSource
from sb3_dreamer_urlb.intrinsic.diayn import DIAYN
from sb3_dreamer_urlb.intrinsic.disagreement import Disagreement
from sb3_dreamer_urlb.intrinsic.icm import ICM
from sb3_dreamer_urlb.intrinsic.lbs import LBS
from sb3_dreamer_urlb.intrinsic.method import ExplorationMethod
from sb3_dreamer_urlb.intrinsic.plan2explore import Plan2Explore
from sb3_dreamer_urlb.intrinsic.random_actions import RandomActions
from sb3_dreamer_urlb.intrinsic.registry import (
    get_intrinsic_reward,
    make_intrinsic_reward,
    register_intrinsic_reward,
    registered_intrinsic_rewards,
)
from sb3_dreamer_urlb.intrinsic.rnd import RND
from sb3_dreamer_urlb.intrinsic.skill_reward import SkillReward
from sb3_dreamer_urlb.intrinsic.skills import OneHotSkills, Skills, UnitSkills
from sb3_dreamer_urlb.intrinsic.transition_reward import EncodedSteps, EncoderSizes, TransitionReward

__all__ = [
    "APS",
    "APT",
    "DIAYN",
    "ICM",
    "LBS",
    "RND",
    "Disagreement",
    "EncodedSteps",
    "EncoderSizes",
    "ExplorationMethod",
    "IntrinsicReward",
    "OneHotSkills",
    "Plan2Explore",
    "RandomActions",
    "RewardHead",
    "RewardSource",
    "SkillReward",
    "Skills",
    "TransitionReward",
    "UnitSkills",
    "get_intrinsic_reward",
    "make_intrinsic_reward",
    "register_intrinsic_reward",
    "registered_intrinsic_rewards",
]

register_intrinsic_reward("icm", ICM)
register_intrinsic_reward("plan2explore", Plan2Explore)
register_intrinsic_reward("rnd", RND)
register_intrinsic_reward("lbs", LBS)
register_intrinsic_reward("apt", APT)
register_intrinsic_reward("diayn", DIAYN)
register_intrinsic_reward("aps", APS)
register_intrinsic_reward("random", RandomActions)
register_intrinsic_reward("disagreement", Disagreement)
