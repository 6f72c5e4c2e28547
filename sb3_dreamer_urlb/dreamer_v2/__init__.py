"""DreamerV2 as a Stable-Baselines3 algorithm."""

from sb3_dreamer_urlb.dreamer_v2.dreamer_v2 import DreamerV2

__all__ = ["DreamerV2"]
