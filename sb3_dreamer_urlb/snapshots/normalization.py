"""VecNormalize's running statistics and settings ↔ tensors of a model's file; SB3's own file of them is a pickle.

The statistics are the file's; the settings are there to be compared with those of a script, or where no script has any.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence

import torch as th
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize

from sb3_dreamer_urlb.snapshots.tensors import Table

#: what the names of these tensors begin with, beside the model's own
PREFIX = "normalization."
RETURN, OBSERVATION = "return", "observation"
#: settings of a VecNormalize that are numbers
NUMBERS = ("clip_obs", "clip_reward", "gamma", "epsilon")
#: tensor of the settings, float64, in this order; older files lack it
SETTINGS = f"{PREFIX}settings"
SETTING_NAMES = (*NUMBERS, "norm_reward")
#: those that change what an agent sees
OF_OBSERVATIONS = ("clip_obs", "epsilon")
#: those that change what it is paid
OF_REWARDS = ("norm_reward", "clip_reward", "gamma")


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


def settings(normalizer: VecNormalize) -> dict[str, float]:
    """By name, as a file holds them: numbers, in place of infinite ones the greatest.

    :param normalizer: whose
    """
    return {name: min(float(getattr(normalizer, name)), sys.float_info.max) for name in SETTING_NAMES}


def pack_whole(normalizer: VecNormalize | None) -> dict[str, th.Tensor]:
    """Statistics, as :func:`pack` gives them, and settings.

    :param normalizer: None without one
    """
    if normalizer is None:
        return {}
    return {**pack(normalizer), SETTINGS: th.tensor([*settings(normalizer).values()], dtype=th.float64)}


def stored_settings(stored: Mapping[str, th.Tensor]) -> dict[str, float]:
    """Those that a file holds, by name; none in older ones.

    :param stored: what :func:`pack_whole` gave
    :raises ValueError: if they are none
    """
    if SETTINGS not in stored:
        return {}
    values = stored[SETTINGS]
    if values.dtype != th.float64 or values.shape != (len(SETTING_NAMES),) or not bool((values >= 0).all()):
        raise ValueError(f"the settings of its VecNormalize are {values.dtype} {list(values.shape)}")
    return dict(zip(SETTING_NAMES, values.tolist(), strict=True))


def differing(
    stored: Mapping[str, th.Tensor], normalizer: VecNormalize, names: Sequence[str] = SETTING_NAMES
) -> tuple[str, str] | None:
    """The settings in which a file's VecNormalize and another differ, as texts for a sentence; None where they agree.

    :param stored: what :func:`pack_whole` gave
    :param normalizer: the other
    :param names: of the settings that count
    """
    theirs, mine = stored_settings(stored), settings(normalizer)
    wrong = [name for name in names if name in theirs and theirs[name] != mine[name]]
    texts = [", ".join(f"{name}={one[name]:g}" for name in wrong) for one in (theirs, mine)]
    return (texts[0], texts[1]) if wrong else None


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
    stored = {name: value for name, value in stored.items() if name != SETTINGS}
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
