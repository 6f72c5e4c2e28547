"""VecNormalize's running statistics ↔ tensors of a model's file; SB3's own file of them is a pickle.

The statistics are the file's, everything else of a VecNormalize (what it normalises, its bounds) is the script's.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch as th
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize

from sb3_dreamer_urlb.snapshots.tensors import Table

#: what the names of these tensors begin with, beside the model's own
PREFIX = "normalization."
RETURN, OBSERVATION = "return", "observation"


def statistics(normalizer: VecNormalize) -> dict[str, RunningMeanStd]:
    """All of them by name: of the discounted return, and of the observation or the parts of a Dict observation.

    :param normalizer: whose
    """
    found = {RETURN: normalizer.ret_rms}
    if normalizer.norm_obs:
        seen = normalizer.obs_rms
        found |= (
            {f"{OBSERVATION}/{key}": part for key, part in seen.items()} if isinstance(seen, dict) else {OBSERVATION: seen}
        )
    return found


def pack(normalizer: VecNormalize | None) -> dict[str, th.Tensor]:
    """As tensors, float64.

    :param normalizer: None without one
    """
    if normalizer is None:
        return {}
    return {
        f"{PREFIX}{name}.{part}": th.as_tensor(getattr(value, part), dtype=th.float64)
        for name, value in statistics(normalizer).items()
        for part in ("mean", "var", "count")
    }


def of_observations(stored: Mapping[str, th.Tensor]) -> dict[str, th.Tensor]:
    """Those of what an agent sees.

    :param stored: what :func:`pack` gave
    """
    return {name: value for name, value in stored.items() if name.startswith(f"{PREFIX}{OBSERVATION}")}


def split(table: Table) -> tuple[Table, Table]:
    """A file's table without the statistics, and theirs."""
    theirs = {name: entry for name, entry in table.items() if name.startswith(PREFIX)}
    return {name: entry for name, entry in table.items() if name not in theirs}, theirs


def restore(normalizer: VecNormalize, stored: dict[str, th.Tensor]) -> None:
    """Put statistics into an environment; all of them, or none.

    :param normalizer: changed in place
    :param stored: what :func:`pack` gave
    :raises ValueError: if they are of something else, or no statistics
    """
    expected = pack(normalizer)
    if expected.keys() != stored.keys():
        raise ValueError(
            f"its VecNormalize had the statistics {sorted(stored)}, that of the environment has {sorted(expected)}"
        )
    for name, value in stored.items():
        if value.dtype != th.float64 or value.shape != expected[name].shape:
            raise ValueError(f"{name} has the shape {list(value.shape)}, the environment's {list(expected[name].shape)}")
        if not name.endswith(".mean") and bool((value < 0).any()):
            raise ValueError(f"{name} holds negative values")
    put(normalizer, stored)


def put(normalizer: VecNormalize, stored: Mapping[str, th.Tensor]) -> None:
    """Put statistics into an environment whose own are of just these shapes; those that are not given stay.

    :param normalizer: changed in place
    :param stored: what :func:`pack` gave, or some of it
    """
    for name, target in statistics(normalizer).items():
        if f"{PREFIX}{name}.mean" not in stored:
            continue
        target.mean = stored[f"{PREFIX}{name}.mean"].numpy().copy()
        target.var = stored[f"{PREFIX}{name}.var"].numpy().copy()
        target.count = float(stored[f"{PREFIX}{name}.count"])
