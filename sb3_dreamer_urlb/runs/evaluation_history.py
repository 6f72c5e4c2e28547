"""SB3's EvalCallback ↔ JSON: the best result so far, when the next evaluation is due, and all results.

A new EvalCallback begins at -inf, overwrites ``best_model.zip`` with whatever comes first and ``evaluations.npz`` with what
comes from then on (docs/reliability.md, "A run that goes on").
"""

from __future__ import annotations

import itertools
import warnings
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from stable_baselines3.common.callbacks import EvalCallback

from sb3_dreamer_urlb.number_checks import is_finite_number, is_integer

#: in the JSON → in the callback, as in ``evaluations.npz``: a list, or one list an evaluation
RESULTS = {
    "timesteps": "evaluations_timesteps",
    "results": "evaluations_results",
    "ep_lengths": "evaluations_length",
    "successes": "evaluations_successes",
}
#: numbers that are worth a place in every checkpoint
MAX_NUMBERS = 100_000


def state(callback: EvalCallback | None) -> dict[str, Any] | None:
    """What to remember, all results among it unless they are too many or not finite.

    :param callback: None without one
    """
    if callback is None:
        return None
    # There may be results and no best one: each phase has its own.
    best = float(callback.best_mean_reward) if np.isfinite(callback.best_mean_reward) else None
    remembered = {"best_mean_reward": best, "n_calls": int(callback.n_calls)}
    lists = {name: [np.asarray(row).tolist() for row in getattr(callback, attribute)] for name, attribute in RESULTS.items()}
    rows = [np.ravel(row) for values in lists.values() for row in values]
    if sum(map(len, rows)) > MAX_NUMBERS or not all(np.isfinite(row).all() for row in rows):
        return remembered
    return {**remembered, **lists}


def checked(remembered: Any) -> dict[str, Any]:
    """What a file says, if it is what :func:`state` gives.

    :raises ValueError: if not
    """
    known = {"best_mean_reward", "n_calls"}
    if not isinstance(remembered, dict) or not known <= set(remembered) <= known | set(RESULTS):
        raise ValueError("its evaluation is damaged")
    best = remembered["best_mean_reward"]
    if not ((best is None or is_finite_number(best)) and is_integer(remembered["n_calls"])):
        raise ValueError("its evaluation is damaged")
    for name in RESULTS.keys() & remembered.keys():
        values = remembered[name]
        rows = [values] if name == "timesteps" else values
        if not isinstance(values, list) or not all(isinstance(row, list) for row in rows):
            raise ValueError("its evaluation is damaged")
        if not all(isinstance(value, bool) or is_finite_number(value) for row in rows for value in row):
            raise ValueError("its evaluation is damaged")
    return remembered


def restore(callback: EvalCallback, remembered: dict[str, Any], steps: int) -> None:
    """Let a new callback go on.

    :param callback: changed in place
    :param remembered: what :func:`checked` let pass
    :param steps: agent steps of the model
    """
    best = remembered["best_mean_reward"]
    callback.best_mean_reward = -np.inf if best is None else float(best)
    callback.n_calls = int(remembered["n_calls"])
    lists = {name: remembered[name] for name in RESULTS.keys() & remembered.keys()} or _written(callback, steps)
    if any(len(row) != callback.n_eval_episodes for row in lists.get("results", [])):
        _put_aside(callback)
        lists = {}
    for name, values in lists.items():
        setattr(callback, RESULTS[name], values)


def _file(callback: EvalCallback) -> Path | None:
    """Where a callback has written its results; None if it has not."""
    path = None if callback.log_path is None else Path(f"{callback.log_path}.npz")
    return path if path is not None and path.is_file() else None


def _written(callback: EvalCallback, steps: int) -> dict[str, list[Any]]:
    """The results of a callback's file until then, where no checkpoint could hold them."""
    if (path := _file(callback)) is None:
        return {}
    try:
        with np.load(path) as file:
            arrays = {name: file[name] for name in RESULTS if name in file}
            kept = arrays["timesteps"] <= steps
            return {name: list(values[kept]) for name, values in arrays.items()}
    except (ValueError, KeyError, IndexError, OSError, BadZipFile):
        _put_aside(callback)
        return {}


def _put_aside(callback: EvalCallback) -> None:
    """One file has equally many episodes each: what does not fit, or cannot be read, stays under another name."""
    if (path := _file(callback)) is None:
        return
    numbers = itertools.count(1)
    aside = next(one for i in numbers if not (one := path.with_name(f"{path.stem}_before_{i}.npz")).exists())
    path.rename(aside)
    warnings.warn(
        f"{path} holds evaluations of another number of episodes than {callback.n_eval_episodes}, or cannot be read: it is "
        f"{aside.name} from now on."
    )
