"""No exploration at all: uniformly random actions while the world model learns (the paper's "Random" baseline)."""

from __future__ import annotations

from typing import ClassVar

from sb3_dreamer_urlb.intrinsic.base import IntrinsicReward


class RandomActions(IntrinsicReward):
    """Acts uniformly at random; only the world model learns."""

    trains_actor: ClassVar[bool] = False
