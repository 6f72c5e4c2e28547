"""SB3's EvalCallback ↔ JSON: the best result so far, when the next evaluation is due, and all results.

A new EvalCallback begins at -inf, overwrites ``best_model.zip`` with whatever comes first and ``evaluations.npz`` with what
comes from then on (docs/reliability.md, "A run that goes on").
"""

from __future__ import annotations

from typing import Any

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
    """What to remember; None before the first result.

    :param callback: None without one
    """
    if callback is None or not np.isfinite(callback.best_mean_reward):
        return None
    remembered = {"best_mean_reward": float(callback.best_mean_reward), "n_calls": int(callback.n_calls)}
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
    if not (is_finite_number(remembered["best_mean_reward"]) and is_integer(remembered["n_calls"])):
        raise ValueError("its evaluation is damaged")
    for name in RESULTS.keys() & remembered.keys():
        values = remembered[name]
        rows = [values] if name == "timesteps" else values
        if not isinstance(values, list) or not all(isinstance(row, list) for row in rows):
            raise ValueError("its evaluation is damaged")
        if not all(isinstance(value, bool) or is_finite_number(value) for row in rows for value in row):
            raise ValueError("its evaluation is damaged")
    return remembered


def restore(callback: EvalCallback, remembered: dict[str, Any]) -> None:
    """Let a new callback go on.

    :param callback: changed in place
    :param remembered: what :func:`checked` let pass
    """
    callback.best_mean_reward = float(remembered["best_mean_reward"])
    callback.n_calls = int(remembered["n_calls"])
    for name in RESULTS.keys() & remembered.keys():
        setattr(callback, RESULTS[name], remembered[name])
