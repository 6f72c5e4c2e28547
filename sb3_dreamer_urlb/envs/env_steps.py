"""What an algorithm makes of the steps of its environments that went wrong (docs/reliability.md, "Environments that fail")."""

from __future__ import annotations

from typing import Any

import numpy as np

from sb3_dreamer_urlb.envs.faults import FAULT, FAULTS, what_is_not_finite


def count_faults(infos: list[dict[str, Any]]) -> int:
    """Faults that guards reported with a step of all environments."""
    return sum(int(info.get(FAULTS, 0)) for info in infos)


def is_fault(info: dict[str, Any]) -> bool:
    """Whether a step did not happen: its row must not be stored, the episode ends before it."""
    return FAULT in info


def check_form(observation: Any, reward: np.ndarray, dones: np.ndarray, n: int) -> None:
    """Whether a vectorised environment, which others may have written, gives one row for each of its environments.

    :param observation: (n, …), or such by name
    :param reward: (n,)
    :param dones: (n,)
    :param n: number of environments
    :raises ValueError: naming what has another form
    """
    parts = observation.items() if isinstance(observation, dict) else [("", observation)]
    for name, part in parts:
        if not isinstance(part, np.ndarray) or part.shape[:1] != (n,):
            what = f"array of the shape {part.shape}" if isinstance(part, np.ndarray) else type(part).__name__
            raise ValueError(
                f"The vectorised environment must give arrays of {n} observations{f' {name!r}' if name else ''}, got {what}."
            )
    for what, values in (("rewards", reward), ("ends", dones)):
        if values.shape != (n,):
            raise ValueError(f"The vectorised environment must give {n} {what}, got an array of the shape {values.shape}.")


def check_finite(observation: Any, reward: np.ndarray, when: str) -> None:
    """Refuse numbers that are none, where no guard caught them.

    :param observation: (n_envs, …), or such by name
    :param reward: (n_envs,)
    :param when: for the message, ``"step 7"`` or ``"reset"``
    :raises ValueError: naming the environment, the step and what is wrong
    """
    if what_is_not_finite(observation, reward) is None:
        return
    for i in range(len(reward)):
        mine = {name: part[i] for name, part in observation.items()} if isinstance(observation, dict) else observation[i]
        reason = what_is_not_finite(mine, reward[i])
        if reason is not None:
            raise ValueError(
                f"Environment {i}, {when}: {reason}; expected finite numbers. To end such episodes and go on, "
                "wrap it in sb3_dreamer_urlb.envs.FaultGuard."
            )
