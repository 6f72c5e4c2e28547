"""What every agent of this package is as an algorithm of Stable-Baselines3: two phases, safe files, runs that go on."""

from sb3_dreamer_urlb.algorithm.phased import PhasedAlgorithm

__all__ = ["PhasedAlgorithm"]
