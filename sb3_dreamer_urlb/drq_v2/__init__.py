"""DrQ-v2, the benchmark's agent without a world model: one file a concern."""

from sb3_dreamer_urlb.drq_v2.drq_v2 import DrQv2

__all__ = ["DrQv2"]
