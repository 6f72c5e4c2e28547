"""A dm_control task as its own numbers tell it: joints, velocities, whatever dm_control observes, in one vector.

Nothing is drawn, so no OpenGL library is needed, and a step costs the physics only. The benchmark's own state variants are
the same for walker and quadruped; those of the Jaco tasks, too, hold what dm_control calls "perfect features": arm, hand and
the brick's pose.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from gymnasium import spaces

from sb3_dreamer_urlb.envs.control_env import ControlEnv
from sb3_dreamer_urlb.envs.pixel_env import image_space

#: Bounds of a state: float32's own. Nothing bounds the numbers, and gymnasium's checker warns of infinite bounds.
STATE_BOUND = float(np.finfo(np.float32).max)


class StateControlEnv(ControlEnv):
    """Observations are float32 (N,), a new array each time: dm_control's own, flattened and joined in dm_control's order, that
    of ``dm_control.rl.control.flatten_observation``. :attr:`state_parts` names what is where. The numbers are not scaled: use
    ``VecNormalize``.

    :raises ValueError: if the task observes nothing but pictures
    """

    #: Name and length of each part of the state, in their order.
    state_parts: tuple[tuple[str, int], ...]

    def _space(self) -> spaces.Space[Any]:
        spec = self._control.observation_spec()
        self.state_parts = tuple((name, int(np.prod(part.shape))) for name, part in spec.items())
        size = sum(length for _, length in self.state_parts)
        if size == 0:
            raise ValueError(f"observation='state': {self.domain}-{self.task} observes nothing but pictures")
        return spaces.Box(-STATE_BOUND, STATE_BOUND, (size,), np.float32)

    def _observe(self, observed: dict[str, Any]) -> Any:
        return self._state(observed)

    def _state(self, observed: dict[str, Any]) -> npt.NDArray[np.float32]:
        parts = [np.ravel(observed[name]) for name, _ in self.state_parts]
        return np.concatenate(parts).astype(np.float32)


class PixelAndStateControlEnv(StateControlEnv):
    """Observations are a Dict: ``"image"``, what :class:`~sb3_dreamer_urlb.envs.pixel_env.PixelControlEnv` sees, and
    ``"state"``, what :class:`StateControlEnv` does.
    """

    def _space(self) -> spaces.Dict:
        return spaces.Dict({"image": image_space(self._options), "state": super()._space()})

    def _observe(self, observed: dict[str, Any]) -> dict[str, npt.NDArray[Any]]:
        return {"image": self._picture(self._options.image_size), "state": self._state(observed)}
