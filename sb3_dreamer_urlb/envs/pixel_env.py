"""A dm_control task as an agent sees it through a camera: the paper's observations."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sb3_dreamer_urlb.envs.control_env import ControlEnv
from sb3_dreamer_urlb.envs.options import PixelOptions


class PixelControlEnv(ControlEnv):
    """Observations are uint8 (image_size, image_size, 3), RGB, C-contiguous, a new array each time; all else stands in
    :class:`~sb3_dreamer_urlb.envs.control_env.ControlEnv`.
    """

    def _space(self) -> spaces.Box:
        return image_space(self._options)

    def _observe(self, observed: dict[str, Any]) -> npt.NDArray[np.uint8]:
        return self._picture(self._options.image_size)


def image_space(options: PixelOptions) -> spaces.Box:
    """Of the pictures that an agent sees."""
    return spaces.Box(0, 255, (options.image_size, options.image_size, 3), np.uint8)
