"""How a control task is shown to an agent: the options every environment of this package takes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from sb3_dreamer_urlb.number_checks import is_choice, is_integer
from sb3_dreamer_urlb.unknown_names import UnknownNameError, did_you_mean

_MIN_SIZE, _MAX_SIZE = 16, 512  # pixels

#: what an agent may see
OBSERVATIONS = ("pixels", "state", "both")

#: what ``render()`` may do
RENDER_MODES = ("rgb_array", "human")


@dataclass(frozen=True)
class PixelOptions:
    """The options, checked when they are made, before dm_control is even imported.

    :param image_size: height and width of the observations in pixels, 16 to 512
    :param action_repeat: control steps an action is held for, at least 1; their rewards are summed
    :param camera: a camera of the model, by id or by name; -1 is MuJoCo's free camera
    :param reward_free: return a reward of 0.0, always; the task's own is in ``info["task_reward"]`` either way
    :param fast_render: draw shadows on a map of 512 x 512 texels instead of 2048 or 4096. About 1.5 times as fast for the
        walker and the quadruped and twice for Jaco, but *not pixel-identical*: some ten of 4096 pixels differ
    :param render_mode: ``None``, ``"rgb_array"``, or ``"human"`` (a window; needs ``pygame`` and a display)
    :param render_size: height and width of what ``render()`` returns, in pixels, 16 to 512
    :param observation: ``"pixels"``; ``"state"``: dm_control's own observation as a float32 vector, no renderer and no OpenGL
        library needed unless ``render()`` is called; ``"both"``: a Dict of ``"image"`` and ``"state"``
    :raises ValueError: naming the option, its value and what was expected
    """

    image_size: int = 64
    action_repeat: int = 2
    camera: int | str = 0
    reward_free: bool = False
    fast_render: bool = False
    render_mode: str | None = None
    render_size: int = 256
    observation: str = "pixels"

    def __post_init__(self) -> None:
        for name in ("image_size", "render_size"):
            size = getattr(self, name)
            if not is_integer(size) or not _MIN_SIZE <= size <= _MAX_SIZE:
                raise ValueError(f"{name}={size!r}: expected an int from {_MIN_SIZE} to {_MAX_SIZE}")
        if not is_integer(self.action_repeat) or self.action_repeat < 1:
            raise ValueError(f"action_repeat={self.action_repeat!r}: expected an int of at least 1")
        if not is_integer(self.camera) and not isinstance(self.camera, str):
            raise ValueError(f"camera={self.camera!r}: expected a camera's id (int) or name (str)")
        for name in ("reward_free", "fast_render"):
            if not isinstance(getattr(self, name), bool | np.bool_):
                raise ValueError(f"{name}={getattr(self, name)!r}: expected True or False")
        if self.render_mode is not None:
            check_choice("render_mode", self.render_mode, RENDER_MODES, "expected None or one of")
        check_choice("observation", self.observation, OBSERVATIONS)
        self._refuse_what_has_no_effect()

    def _refuse_what_has_no_effect(self) -> None:
        """Options about pictures, where there are none."""
        if self.observation == "state" and self.image_size != PixelOptions.image_size:
            raise ValueError(
                f"image_size={self.image_size!r}: observation='state' holds no image; leave it out, or ask for 'both'"
            )
        for name in ("fast_render", "render_size"):
            if getattr(self, name) != getattr(PixelOptions, name):
                refuse_where_nothing_is_drawn(name, getattr(self, name), self.observation, self.render_mode)


def refuse_where_nothing_is_drawn(name: str, value: Any, observation: Any, render_mode: Any) -> None:
    """
    :param name: of an option about pictures
    :param value: what was given
    :param observation: option of that name
    :param render_mode: option of that name
    :raises ValueError: if there are no pictures
    """
    if isinstance(observation, str) and observation == "state" and render_mode is None:
        raise ValueError(f"{name}={value!r}: observation='state' without a render_mode draws nothing; leave it out")


def refuse_unknown(unknown: dict[str, Any], *others: str) -> None:
    """Name options that there are not.

    :param unknown: by name, what was left over
    :param others: known ones besides those of :class:`PixelOptions`
    :raises UnknownNameError: if there are any; it lists the known ones
    """
    if unknown:
        known = sorted([*(field.name for field in fields(PixelOptions)), *others])
        raise UnknownNameError(
            f"unknown option{'s' * (len(unknown) > 1)} {', '.join(unknown)}: known are {', '.join(known)}."
            f"{did_you_mean(unknown, known)}"
        )


def check_choice(name: str, value: Any, known: Sequence[str], there_are: str = "expected one of") -> None:
    """
    :param name: of an option
    :param value: what was given
    :param known: what may be given
    :param there_are: what the message says before it lists them
    :raises ValueError: naming the option, its value and the known ones
    """
    if not is_choice(value, known):
        raise ValueError(f"{name}={value!r}: {there_are} {', '.join(known)}")
