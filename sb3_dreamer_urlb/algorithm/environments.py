"""How an algorithm takes an environment: wrapped, checked, asked what it tells, seen through the statistics it knows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch as th
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv

from sb3_dreamer_urlb.algorithm import advice, left_environments, normalized
from sb3_dreamer_urlb.algorithm.assignable_arguments import AssignableArguments
from sb3_dreamer_urlb.algorithm.collecting import CollectingAlgorithm
from sb3_dreamer_urlb.algorithm.environment_checks import check_env, check_keeps_fractions, given_env
from sb3_dreamer_urlb.envs.facts import env_fact
from sb3_dreamer_urlb.envs.naming import task_of
from sb3_dreamer_urlb.envs.normalized import watch_ends
from sb3_dreamer_urlb.envs.touches import last_touches
from sb3_dreamer_urlb.phases import PHASES


class EnvironmentAlgorithm(AssignableArguments, CollectingAlgorithm):
    """The part of :class:`PhasedAlgorithm` that takes environments: in the constructor, by ``set_env``, by assignment."""

    #: of the environment's task, None where it does not tell
    domain: str | None
    #: whether :meth:`set_env` is at work, which assigns
    _sets_env = False

    @staticmethod
    def _wrap_env(env: GymEnv | str, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        wrapped = CollectingAlgorithm._wrap_env(given_env(env), verbose, monitor_wrapper)
        check_keeps_fractions(wrapped)
        return wrapped

    def prepare_env(self, env: GymEnv | str) -> VecEnv:
        """Wrap an environment as SB3 does, and check that this model can go on in it.

        :param env: vectorised or not, or its id
        :raises ValueError: if it does not fit
        """
        wrapped = self._wrap_env(env, self.verbose)
        self._check_env(wrapped)
        return wrapped

    def __setattr__(self, name: str, value: Any) -> None:
        """As ever; another environment that is assigned is set, as by :meth:`set_env`."""
        if name == "env" and "policy" in vars(self) and not (self._sets_env or value is None or value is self.env):
            self.set_env(value)
        else:
            super().__setattr__(name, value)

    def _check_env(self, env: VecEnv) -> None:
        check_env(self, env)

    def set_env(self, env: GymEnv | str, force_reset: bool = True) -> None:
        """As SB3's; also checks what else the model needs of it, and reads the new environment's action repeat.

        :param env: with the model's number of environments and its spaces; an id makes one
        :param force_reset: reset it before going on; False does not if it stands where the model left it, wrapped as then
        :raises ValueError: if it does not fit; the model stays as it is
        """
        wrapped, known = self.prepare_env(env), self.known_statistics()
        self._sets_env = True
        try:
            super().set_env(wrapped, force_reset)
        finally:
            self._sets_env = False
        if left_environments.found(wrapped) is None:
            # What was seen last, was seen elsewhere, or through other wrappers.
            self._last_obs = None
        self._read_env()
        self._go_on_normalized(known)

    def _go_on_normalized(self, known: Mapping[str, th.Tensor]) -> None:
        if max(self.phase_timesteps, self.num_timesteps) > 0:
            if not PHASES[self.phase].explores:
                normalized.warn_of_rewards(known, self._vec_normalize_env)
            normalized.go_on(known, self._vec_normalize_env)

    def _read_env(self) -> None:
        """What the environment tells about itself beyond its spaces."""
        if self.env is None:
            return
        # Watched from now on, also while others step it.
        last_touches(self.env)
        if self._vec_normalize_env is not None:
            watch_ends(self._vec_normalize_env)
        self.action_repeat = env_fact(self.env, "action_repeat", 1)
        self.domain = env_fact(self.env, "domain", None)
        self._task = task_of(self.env)
        self._hides_rewards = env_fact(self.env, "reward_free", False)
        advice.warn_if_no_episode_fits(self)
