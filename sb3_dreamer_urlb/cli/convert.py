"""Stable-Baselines3's own form of a DreamerV2 (a zip with pickles) → a safe snapshot. Loading a pickle can run any code."""

from __future__ import annotations

import os
import warnings
import zipfile

from stable_baselines3.common.base_class import BaseAlgorithm

from sb3_dreamer_urlb.dreamer_v2 import DreamerV2
from sb3_dreamer_urlb.snapshots import bounded_json
from sb3_dreamer_urlb.snapshots.archive import blaming, kind_of
from sb3_dreamer_urlb.snapshots.atomic import path_to_read


def convert(old: str | os.PathLike[str], new: str | os.PathLike[str], trust: bool) -> DreamerV2:
    """Read a file of the old form and write it in the new.

    :param old: what Stable-Baselines3's ``save`` wrote
    :param new: path to write
    :param trust: whoever made ``old`` may run code on this machine
    :return: the converted model
    :raises ValueError: without ``trust``, if it is no such file, or in the new form already
    """
    path = path_to_read(old, "zip")
    if kind_of(path) is not None:
        raise ValueError(f"{path} is in the safe form already.")
    if (whose := _other_algorithm(path)) is not None:
        raise ValueError(f"{path} holds a model of {whose}, not of DreamerV2.")
    if not trust:
        raise ValueError(
            f"Loading {os.fspath(old)} can run any code that its maker put in. If you trust where it comes from, add --trust."
        )
    with warnings.catch_warnings(), blaming(str(path)):
        warnings.simplefilter("ignore")
        # DreamerV2's own load is the safe one.
        model: DreamerV2 = BaseAlgorithm.load.__func__(DreamerV2, path, device="cpu")  # type: ignore[attr-defined]
    model.save(new)
    return model


def _other_algorithm(path: str | os.PathLike[str]) -> str | None:
    """Whose policy a file of Stable-Baselines3's holds, where it lacks what every DreamerV2 has; its JSON runs no code."""
    try:
        with zipfile.ZipFile(path) as file:
            data = bounded_json.parse(file.read("data"))
        return None if "intrinsic_reward" in data else str(data["policy_class"]["__module__"])
    except (OSError, KeyError, TypeError, ValueError, zipfile.BadZipFile):
        return None  # what is wrong with it, its reader says
