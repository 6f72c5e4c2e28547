"""Environments that raise or give numbers that are none: the episode is cut short, counted, and the run goes on.

A step that failed is marked in its ``info``, so that the replay ends the episode there as truncated and never stores the
row (docs/reliability.md, "Environments that fail"). :class:`FaultGuard` does it inside a process,
:class:`~sb3_dreamer_urlb.envs.supervisor.SupervisedVecEnv` for processes that die or hang.
"""

from __future__ import annotations

import copy
import warnings
from typing import Any

import gymnasium
import numpy as np
from gymnasium.error import ClosedEnvironmentError, DependencyNotInstalled, ResetNeeded

#: in ``info``: why this step did not happen. What it returned is made up.
FAULT = "env_fault"
#: in ``info``: faults since the last step, those while resetting included
FAULTS = "env_faults"
#: good steps after which earlier faults are forgiven
FORGIVEN_AFTER = 1000


class EnvironmentFaultError(RuntimeError):
    """An environment failed again and again; the message says which, when and how."""


#: what no reset mends, since it is not the environment that went wrong; the first is a guard's inside this one
NO_FAULTS = (EnvironmentFaultError, ClosedEnvironmentError, ResetNeeded, DependencyNotInstalled)


class FaultCounter:
    """Faults in a row: with neither a whole episode nor ``FORGIVEN_AFTER`` good steps between them.

    :param name: of the environment, for messages
    :param max_faults: in a row
    :raises ValueError: if that is not positive
    """

    def __init__(self, name: str, max_faults: int):
        if max_faults < 1:
            raise ValueError(f"max_faults must be positive, got {max_faults}.")
        self.name, self.max_faults = name, max_faults
        self.in_a_row, self.steps, self.good_steps = 0, 0, 0
        self._new = 0

    def good(self, done: bool) -> None:
        """A step went well; ``done``, if it ended the episode."""
        self.steps += 1
        self.good_steps += 1
        if done or self.good_steps >= FORGIVEN_AFTER:
            self.in_a_row, self.good_steps = 0, 0

    def bad(self, reason: str) -> str:
        """Count a fault, and warn of it.

        :param reason: what happened
        :return: the same with the environment's name and step
        :raises EnvironmentFaultError: if it is one too many
        """
        self.steps += 1
        self.in_a_row += 1
        self.good_steps = 0
        self._new += 1
        text = f"{self.name}, step {self.steps}: {reason}"
        if self.in_a_row >= self.max_faults:
            raise EnvironmentFaultError(f"{text}. That was fault {self.in_a_row} in a row (max_faults={self.max_faults}).")
        warnings.warn(f"{text}. The episode ends here as truncated.", RuntimeWarning)
        return text

    def take(self) -> int:
        """Faults since the last call."""
        new, self._new = self._new, 0
        return new


class FaultGuard(gymnasium.Wrapper):
    """Goes on where an environment raises (dm_control's ``PhysicsError`` or any other error) or gives NaN or infinity.

    The step is reported as truncated, with the last good observation and no reward, and ``info["env_fault"]`` tells why;
    the caller resets as after any other episode. A reset that fails is tried again. Not so a closed environment, a step
    before the first reset, and a package that is missing: these errors come through.

    :param env: the environment
    :param max_faults: in a row that are too many: with neither a whole episode nor 1000 good steps between them
    :param name: for messages; None for the environment's own
    :raises ValueError: for numbers that are not positive
    """

    def __init__(self, env: gymnasium.Env, max_faults: int = 10, name: str | None = None):
        super().__init__(env)
        self.faults = FaultCounter(str(env) if name is None else name, max_faults)
        self._last: Any = None
        self._closed = False

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """
        :raises EnvironmentFaultError: after ``max_faults`` failures in a row
        :raises gymnasium.error.ClosedEnvironmentError: if it fails and was closed
        """
        while True:
            try:
                observation, info = self.env.reset(seed=seed, options=options)
                reason = what_is_not_finite(observation, 0.0)
            except Exception as error:
                reason = self._fault(error)
            if reason is None:
                self._last = copy.deepcopy(observation)
                return observation, info
            self.faults.bad(f"reset: {reason}")
            # The same seed would fail in the same way.
            seed = None if seed is None else (seed + 1) % 2**32

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """:raises ValueError: for an action that is not finite: that is the agent's fault
        :raises EnvironmentFaultError: after ``max_faults`` failures in a row
        :raises gymnasium.error.ClosedEnvironmentError: if it fails and was closed
        """
        check_finite_action(action, self.faults.name, self.faults.steps + 1)
        try:
            observation, reward, terminated, truncated, info = self.env.step(action)
            reason = what_is_not_finite(observation, reward)
        except Exception as error:
            reason = self._fault(error)
        if reason is not None:
            text = self.faults.bad(reason)
            return self._last, 0.0, False, True, {FAULT: text, FAULTS: self.faults.take()}
        # Environments may write the next observation, good or bad, into the same array.
        self._last = copy.deepcopy(observation)
        self.faults.good(terminated or truncated)
        if new := self.faults.take():
            info = {**info, FAULTS: new}
        return observation, reward, terminated, truncated, info

    def close(self) -> None:
        """Close it; some environments can be used again."""
        self._closed = True
        super().close()

    def _fault(self, error: Exception) -> str:
        """What went wrong, in words.

        :raises Exception: if it is no fault of the environment
        """
        if isinstance(error, NO_FAULTS):
            raise error
        if self._closed:
            raise closed(self.faults.name) from error
        return describe(error)


def closed(name: str) -> ClosedEnvironmentError:
    """The error of whoever is used after ``close()``.

    :param name: of the environment
    """
    return ClosedEnvironmentError(f"{name} was closed: make a new one.")


def describe(error: BaseException) -> str:
    """An error in one line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())[:500]}"


def what_is_not_finite(observation: Any, reward: Any) -> str | None:
    """What of a step is NaN or infinite, None if nothing is.

    :param observation: array, or arrays by name
    :param reward: number or array
    """
    parts = observation if isinstance(observation, dict) else {"": observation}
    for name, part in parts.items():
        values = np.asarray(part)
        if values.dtype.kind in "fc" and not np.isfinite(values).all():
            return f"the observation{f' {name!r}' if name else ''} is not finite"
    if not np.isfinite(reward).all():
        return f"the reward is {reward}"
    return None


def check_finite_action(action: Any, name: str, step: int) -> None:
    """:raises ValueError: if an action is NaN or infinite; many simulators would pass it on in silence"""
    if not np.isfinite(action).all():
        raise ValueError(f"{name}, step {step}: the agent's action {np.asarray(action)} is not finite.")
