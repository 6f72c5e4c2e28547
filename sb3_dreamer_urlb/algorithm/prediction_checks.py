"""What ``predict`` is handed beside an observation: a state and starts of episodes that fit, or one error that says why."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch as th

from sb3_dreamer_urlb.types import Observation

WHOLE_NUMBERS = "biu"
NUMBERS = WHOLE_NUMBERS + "f"
STATE = "state must be what the last predict() of this policy returned"


def observed(observation: Observation) -> int:
    """How many environments an observation is of.

    :param observation: (n, …), or such by name
    :raises ValueError: for none at all, or parts of unequal n
    """
    parts = observation if isinstance(observation, dict) else {"": observation}
    counts = {name: len(part) for name, part in parts.items()}
    if len(set(counts.values())) > 1:
        raise ValueError(f"The observation's parts must be of equally many environments, got {counts}.")
    n = min(counts.values())
    if n == 0:
        raise ValueError("The observation is of no environment: predict() needs at least one.")
    return n


def checked_starts(episode_start: Any, n: int) -> np.ndarray:
    """Where episodes begin, bool (n,).

    :param episode_start: true or false, or 1 and 0, for each environment; None for nowhere
    :param n: number of environments
    :raises ValueError: for anything else
    """
    if episode_start is None:
        return np.zeros(n, bool)
    starts = np.asarray(episode_start).reshape(-1)
    if starts.dtype.kind not in NUMBERS or not np.isin(starts, (0, 1)).all():
        raise ValueError(f"episode_start must be true or false for each environment, got {episode_start!r}.")
    if len(starts) != n:
        raise ValueError(f"episode_start has {len(starts)} entries for {n} observation(s).")
    return starts.astype(bool)


def checked_state(
    state: Any, n: int, shapes: Sequence[tuple[int, ...] | None], dtypes: Sequence[np.dtype[Any]]
) -> tuple[np.ndarray, ...]:
    """An agent's memory as arrays of the types that it has, also where it went through lists or JSON.

    :param state: arrays with leading n, or what numpy makes one of
    :param n: number of environments
    :param shapes: of the parts without n; None where any will do
    :param dtypes: of the parts
    :raises ValueError: for other parts, another n, other shapes, and numbers that no such part can have
    """
    if not isinstance(state, tuple) or len(state) != len(shapes):
        got = f"a tuple of {len(state)}" if isinstance(state, tuple) else type(state).__name__
        raise ValueError(f"state must be what the last predict() returned, a tuple of {len(shapes)} arrays, got {got}.")
    found = [np.shape(part) for part in state]
    if any(len(shape) == 0 or shape[0] != n for shape in found):
        whose = " or ".join(map(str, dict.fromkeys((*shape, 0)[0] for shape in found)))
        raise ValueError(f"state is for {whose} environments, the observation for {n}.")
    expected = [its[1:] if shape is None else shape for its, shape in zip(found, shapes, strict=True)]
    if [its[1:] for its in found] != expected:
        raise ValueError(f"{STATE}, arrays of the shapes {[(n, *shape) for shape in expected]}, got {found}.")
    return tuple(_part(i, part, dtype) for i, (part, dtype) in enumerate(zip(state, dtypes, strict=True)))


def _part(i: int, part: Any, dtype: np.dtype[Any]) -> np.ndarray:
    array = part.detach().cpu().numpy() if isinstance(part, th.Tensor) else np.asarray(part)
    whole = dtype.kind in WHOLE_NUMBERS
    fits = array.dtype.kind in NUMBERS and bool(np.isfinite(array).all())
    if not fits or (whole and not ((array >= 0) & (array == np.floor(array))).all()):
        kind = "whole numbers of at least 0" if whole else "finite numbers"
        raise ValueError(f"{STATE}: its part {i} holds {kind}, got {array.dtype} {str(array)[:80]}.")
    # Copies only what is of another type, and what torch does not take: arrays that nobody may write to.
    return np.require(array, dtype, "W")
