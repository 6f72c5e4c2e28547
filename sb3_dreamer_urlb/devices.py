"""Which device a model is on."""

from __future__ import annotations

import warnings

import torch as th
from stable_baselines3.common.utils import get_device


def chosen_device(device: th.device | str) -> th.device:
    """As Stable-Baselines3 chooses it, which takes the CPU where there is no CUDA; this also says so.

    :param device: ``"auto"``, ``"cpu"``, ``"cuda"``, or torch's
    :raises RuntimeError: by torch, for a device that it does not know
    """
    chosen = get_device(device)
    if device != "auto" and chosen.type != th.device(device).type:
        warnings.warn(
            f"device={str(device)!r}: torch {th.__version__} finds no such device here, {chosen} is used.", stacklevel=2
        )
    return chosen
