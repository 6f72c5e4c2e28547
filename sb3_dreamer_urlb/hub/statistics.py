"""The statistics of SB3's ``VecNormalize`` as JSON. SB3 pickles them, and a stranger's pickle can run any code."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_dreamer_urlb.number_checks import is_finite_number
from sb3_dreamer_urlb.snapshots import bounded_json
from sb3_dreamer_urlb.snapshots.archive import blaming
from sb3_dreamer_urlb.snapshots.atomic import written_atomically

NUMBERS = ("clip_obs", "clip_reward", "gamma", "epsilon")
FIELDS = {*NUMBERS, "norm_obs", "norm_reward", "norm_obs_keys", "observations", "returns"}
MAX_BYTES = 8 << 20


def save_vec_normalize(env: VecNormalize, path: str | os.PathLike[str]) -> None:
    """Write settings and statistics.

    :param env: normalised environment
    :param path: of the JSON file
    """
    observations: Any = None
    if env.norm_obs:
        rms: Any = env.obs_rms
        observations = {key: _numbers(part) for key, part in rms.items()} if isinstance(rms, dict) else _numbers(rms)
    data = {
        **{name: float(getattr(env, name)) for name in NUMBERS},
        "norm_obs": env.norm_obs,
        "norm_reward": env.norm_reward,
        "norm_obs_keys": env.norm_obs_keys,
        "observations": observations,
        "returns": _numbers(env.ret_rms),
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
        data = bounded_json.parse(Path(path).read_bytes())
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
        if env.norm_obs:
            _put(env, data["observations"])
        _fill(env.ret_rms, data["returns"])
        return env


def _put(env: VecNormalize, stored: Any) -> None:
    rms: Any = env.obs_rms
    if not isinstance(rms, dict):
        return _fill(rms, stored)
    if not isinstance(stored, dict) or set(stored) != set(rms):
        raise ValueError(f"it normalises other observations than {sorted(rms)}")
    for key, part in rms.items():
        _fill(part, stored[key])
    return None


def _numbers(rms: RunningMeanStd) -> dict[str, Any]:
    return {"mean": np.asarray(rms.mean).tolist(), "var": np.asarray(rms.var).tolist(), "count": float(rms.count)}


def _fill(rms: RunningMeanStd, stored: Any) -> None:
    if not isinstance(stored, dict) or set(stored) != {"mean", "var", "count"}:
        raise ValueError("its statistics have other fields than they should")
    for name in ("mean", "var"):
        values = np.array(stored[name], np.float64)
        if values.shape != rms.mean.shape or not np.isfinite(values).all() or (name == "var" and (values < 0).any()):
            raise ValueError(f"its {name} has the shape {values.shape}, expected {rms.mean.shape}, finite")
        setattr(rms, name, values)
    rms.count = _number("count", stored["count"])


def _number(name: str, value: Any) -> float:
    if not is_finite_number(value) or value < 0:
        raise ValueError(f"its {name} is {str(value)[:80]}")
    return float(value)


def _keys(keys: Any) -> list[str] | None:
    if keys is not None and not (isinstance(keys, list) and all(isinstance(key, str) for key in keys)):
        raise ValueError("its norm_obs_keys are no list of names")
    return keys
