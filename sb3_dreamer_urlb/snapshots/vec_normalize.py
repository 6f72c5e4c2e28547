"""The statistics of SB3's ``VecNormalize`` as JSON. SB3 pickles them, and a stranger's pickle can run any code."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_dreamer_urlb.number_checks import is_finite_number
from sb3_dreamer_urlb.snapshots import bounded_json, normalization
from sb3_dreamer_urlb.snapshots.archive import PICKLE_BEGINS, blaming
from sb3_dreamer_urlb.snapshots.atomic import written_atomically
from sb3_dreamer_urlb.snapshots.normalization import NUMBERS

FIELDS = {*NUMBERS, "norm_obs", "norm_reward", "norm_obs_keys", "statistics"}
MAX_BYTES = 8 << 20
PICKLE = (
    "it is a pickle, as VecNormalize.save writes them, and loading it could run any code. If you trust where it comes from: "
    "save_vec_normalize(VecNormalize.load(OLD, venv), NEW) of sb3_dreamer_urlb.hub"
)
#: ending of the file of statistics that belongs to the snapshot of the same name
BESIDE = ".vec_normalize.json"


def beside(snapshot: Path) -> Path:
    """Where the statistics of a snapshot lie.

    :param snapshot: ``NAME.zip``
    """
    return snapshot.with_name(snapshot.name.removesuffix(".zip") + BESIDE)


def save_vec_normalize(env: VecNormalize, path: str | os.PathLike[str]) -> None:
    """Write settings and statistics.

    :param env: normalised environment
    :param path: of the JSON file
    """
    data = {
        **{name: float(getattr(env, name)) for name in NUMBERS},
        "norm_obs": env.norm_obs,
        "norm_reward": env.norm_reward,
        "norm_obs_keys": env.norm_obs_keys,
        "statistics": {name: value.tolist() for name, value in normalization.pack(env).items()},
    }
    with written_atomically(path) as file:
        file.write(bounded_json.dump(data))


def load_vec_normalize(path: str | os.PathLike[str], venv: VecEnv, training: bool = False) -> VecNormalize:
    """Normalise an environment as another was. No code runs from the file.

    :param path: what :func:`save_vec_normalize` wrote
    :param venv: not normalised yet
    :param training: go on collecting statistics, and normalise rewards if the file says so
    :raises SnapshotError: if the file is damaged, or of an environment with other observations
    """
    with blaming(os.fspath(path)):
        size = Path(path).stat().st_size
        if size > MAX_BYTES:
            raise ValueError(f"it has {size} bytes")
        content = Path(path).read_bytes()
        if content.startswith(PICKLE_BEGINS):
            raise ValueError(PICKLE)
        data = bounded_json.parse(content)
        if not isinstance(data, dict) or set(data) != FIELDS:
            raise ValueError("it has other fields than it should")
        settings = {name: _number(name, data[name]) for name in NUMBERS}
        for name in ("norm_obs", "norm_reward"):
            if not isinstance(data[name], bool):
                raise ValueError(f"its {name} is neither true nor false")
        norm_reward = training and data["norm_reward"]
        env = VecNormalize(
            venv, training, data["norm_obs"], norm_reward, norm_obs_keys=_keys(data["norm_obs_keys"]), **settings
        )
        if not isinstance(data["statistics"], dict):
            raise ValueError("its statistics have no names")
        normalization.restore(
            env, {name: th.from_numpy(np.array(value, np.float64)) for name, value in data["statistics"].items()}
        )
        return env


def _number(name: str, value: Any) -> float:
    if not is_finite_number(value) or value < 0:
        raise ValueError(f"its {name} is {str(value)[:80]}")
    return float(value)


def _keys(keys: Any) -> list[str] | None:
    if keys is not None and not (isinstance(keys, list) and all(isinstance(key, str) for key in keys)):
        raise ValueError("its norm_obs_keys are no list of names")
    return keys
