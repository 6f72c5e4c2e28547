"""Which device a model is on."""

from __future__ import annotations

import warnings

import torch as th
from stable_baselines3.common.utils import get_device

from sb3_dreamer_urlb.unknown_names import did_you_mean

#: what most models are on
USUAL = ("auto", "cpu", "cuda")
#: what torch calls by another name
OTHER_NAMES = {"gpu": "cuda", "nvidia": "cuda", "metal": "mps", "apple": "mps"}


class UnknownDeviceError(ValueError, RuntimeError):
    """A wrong value as all others are, and the RuntimeError that torch has for it."""


def chosen_device(device: th.device | str) -> th.device:
    """As Stable-Baselines3 chooses it, which takes the CPU where there is no CUDA; this also says so.

    :param device: ``"auto"``, ``"cpu"``, ``"cuda"``, or torch's
    :raises UnknownDeviceError: for a device that torch does not know
    """
    chosen = known_device(device)
    if device != "auto" and chosen.type != th.device(device).type:
        warnings.warn(
            f"device={str(device)!r}: torch {th.__version__} finds no such device here, {chosen} is used.", stacklevel=2
        )
    return chosen


def known_device(device: th.device | str, argument: str = "device") -> th.device:
    """As Stable-Baselines3 chooses it, in silence.

    :param device: see :func:`chosen_device`
    :param argument: what the caller calls it, for the message
    :raises UnknownDeviceError: likewise
    """
    try:
        return get_device(device)
    except (RuntimeError, TypeError, ValueError, OverflowError) as error:
        raise UnknownDeviceError(
            f"{argument} must be {_usual()} or another of torch's, got {device!r}{_hint(device)}"
        ) from error


def _usual() -> str:
    return ", ".join(f'"{name}"' for name in USUAL) + ', "cuda:1"'


def _hint(device: object) -> str:
    """The end of a message: what may have been meant."""
    if not isinstance(device, str):
        return "."
    name, _, number = device.lower().partition(":")
    if name in OTHER_NAMES:
        meant = OTHER_NAMES[name] + (f":{number}" if number else "")
        return f': torch calls it "{meant}".'
    return "." + did_you_mean([name], [usual for usual in USUAL if usual[:2] == name[:2]])
