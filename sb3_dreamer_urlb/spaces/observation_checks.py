"""What ``predict`` is handed in as an observation: numbers of the right shape, or one error that says what was expected."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces

Observation = np.ndarray | dict[str, np.ndarray]
#: characters of what was given, in messages
SHOWN = 80


def checked_observation(observation: Any, space: spaces.Space[Any]) -> Observation:
    """As arrays; what is left to Stable-Baselines3's own checks has numbers in it, and an image's number of axes.

    :param observation: of one environment or with a leading n; arrays, or what numpy makes one of, or such by name
    :param space: of one environment, images with channels first
    :raises ValueError: naming what was given and what was expected
    """
    if isinstance(observation, tuple):
        raise ValueError("predict() takes the observation, got a tuple: Gymnasium's `obs, info = env.reset()`?")
    if isinstance(space, spaces.Dict):
        if not isinstance(observation, dict):
            raise ValueError(f"The observation must be a dictionary of {sorted(space.keys())}, got {_shown(observation)}.")
        unknown = sorted(set(observation) - set(space.keys()))
        if unknown:
            raise ValueError(f"The observation has the parts {unknown}; known are {sorted(space.keys())}.")
        return {name: _array(f"The observation {name!r}", part, space[name]) for name, part in observation.items()}
    # A dictionary is refused by Stable-Baselines3, which names the space.
    return observation if isinstance(observation, dict) else _array("The observation", observation, space)


def _array(name: str, value: Any, space: spaces.Space[Any]) -> np.ndarray:
    shape: tuple[int, ...] = space.shape or ()
    if isinstance(value, th.Tensor):
        value = value.detach().cpu()
        value = value.float() if value.dtype == th.bfloat16 else value  # numpy has none
    try:
        array = np.asarray(value)
        numbers = array.dtype.kind in "biuf"
    except ValueError:  # rows of different lengths
        numbers = False
    if not numbers:
        raise ValueError(f"{name} must be numbers of the shape {shape}, or (n, *{shape}), got {_shown(value)}.")
    if len(shape) == 3 and array.ndim not in (3, 4):
        raise ValueError(
            f"{name} must have the shape {shape}, its channels first or last, or with a leading n: got {array.shape}."
        )
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, got {_numbers(array)}.")
    check_classes(name, array, space)
    # Views with negative strides (a mirrored image) are arrays that torch does not take.
    return np.ascontiguousarray(array).reshape(array.shape)


def check_classes(name: str, observation: Any, space: spaces.Space[Any]) -> None:
    """Whether choices are among those of their space: torch would only say that an index is out of bounds, or round them.

    :param name: of the observation, which begins the message
    :param observation: array of one environment or with a leading n; or several by name
    :param space: of one environment
    :raises ValueError: naming the numbers and the space
    """
    if isinstance(space, spaces.Dict):
        for part, its in space.spaces.items():
            if part in observation:
                check_classes(f"{name} {part!r}", observation[part], its)
    if not isinstance(space, spaces.Discrete | spaces.MultiDiscrete | spaces.MultiBinary):
        return
    array = np.asarray(observation)
    least, count = (0, 2) if isinstance(space, spaces.MultiBinary) else (space.start, _counts(space))
    wrong_shape = array.ndim < len(space.shape or ()) or (space.shape and array.shape[-len(space.shape) :] != space.shape)
    if not wrong_shape and not ((array >= least) & (array < least + count) & (array == np.floor(array))).all():
        raise ValueError(f"{name} must be in {space}, got {_numbers(array)}.")


def _counts(space: spaces.Discrete | spaces.MultiDiscrete) -> Any:
    return space.n if isinstance(space, spaces.Discrete) else space.nvec


def _numbers(array: np.ndarray) -> str:
    """The whole array where it is short; of a long one the first and last numbers, and how many are not finite."""
    whole = str(array.tolist()) if array.size <= SHOWN else ""
    if 0 < len(whole) <= SHOWN:
        return whole
    ends = [f"{number:g}" for number in array.reshape(-1)[[0, 1, -2, -1]].tolist()]
    wrong = np.count_nonzero(~np.isfinite(array))
    how_many = f", {wrong} of {array.size} not finite" if wrong else ""
    return f"[{', '.join([*ends[:2], '...', *ends[2:]])}] of the shape {array.shape}{how_many}"


def _shown(value: Any) -> str:
    text = str(value)
    return f"{type(value).__name__} {text if len(text) <= SHOWN else text[: SHOWN - 3] + '...'!r}"
