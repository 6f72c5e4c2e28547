"""Environments in processes that may die, raise or hang (docs/reliability.md, "Environments that fail")."""

from __future__ import annotations

import atexit
import inspect
import math
import warnings
import weakref
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env.base_vec_env import (
    CloudpickleWrapper,
    VecEnv,
    VecEnvIndices,
    VecEnvObs,
    VecEnvStepReturn,
)
from stable_baselines3.common.vec_env.util import dict_to_obs, obs_space_info

from sb3_dreamer_urlb.envs.faults import FAULT, FAULTS, EnvironmentFaultError, FaultCounter, check_finite_action, closed
from sb3_dreamer_urlb.envs.info_keys import TERMINAL, TRUNCATED
from sb3_dreamer_urlb.envs.worker import Worker, WorkerFault, end_all, start_context
from sb3_dreamer_urlb.number_checks import check_integer
from sb3_dreamer_urlb.unknown_names import check_keys

#: seconds that close() gives workers before it ends them by force
GRACE = 2.0


class SupervisedVecEnv(VecEnv):
    """SB3's SubprocVecEnv for long runs: a worker that dies or hangs is replaced, one whose environment raises goes on.

    The step at which it happened is reported as the end of the episode, truncated, with ``info["env_fault"]``; the
    replay ends the stream there. Environments are wrapped in :class:`~sb3_dreamer_urlb.envs.FaultGuard`.

    :param env_fns: make the environments
    :param start_method: ``"forkserver"`` (default) or ``"spawn"``; ``"fork"`` is refused
    :param step_timeout: seconds that a step or a reset may take before its process counts as hanging
    :param start_timeout: seconds that a process may take to start and to make its environment
    :param max_faults: faults of one environment in a row that end the run
    :raises ValueError: for arguments that do not fit
    :raises EnvironmentFaultError: if an environment cannot be made
    """

    def __init__(
        self,
        env_fns: Sequence[Callable[[], gymnasium.Env]],
        start_method: str | None = None,
        step_timeout: float = 60.0,
        start_timeout: float = 180.0,
        max_faults: int = 10,
    ):
        for name, seconds in (("step_timeout", step_timeout), ("start_timeout", start_timeout)):
            if not 0 < seconds < math.inf:
                raise ValueError(f"{name} must be positive and finite, got {seconds!r}.")
        self.context = start_context(start_method)
        self.env_fns = [CloudpickleWrapper(env_fn) for env_fn in env_fns]
        self.step_timeout, self.start_timeout, self.max_faults = step_timeout, start_timeout, max_faults
        self.closed = self.waiting = False
        self.counters = [FaultCounter(f"Environment {i}", max_faults) for i in range(len(env_fns))]
        #: environments that were replaced outside a step: what happened, and the first observation since
        self._lost: dict[int, tuple[str, Any, dict[str, Any]]] = {}
        self._last: list[Any] = [None] * len(env_fns)
        self._set: list[dict[str, Any]] = [{} for _ in env_fns]
        self._first_seeds: list[int | None] = [None] * len(env_fns)
        self._generations = [0] * len(env_fns)
        self.workers: list[Worker] = []
        # Before multiprocessing's own end of the process, which would wait for a worker that hangs.
        atexit.register(_close, weakref.ref(self))
        try:
            for i in range(len(env_fns)):
                self.workers.append(self._new_worker(i))
            for worker in self.workers:
                worker.send("spaces")
            answers = [worker.receive() for worker in self.workers]
        except Exception as error:
            self.close()
            if isinstance(error, WorkerFault):
                raise EnvironmentFaultError(
                    f"An environment cannot be made: {error}. A script makes such environments below "
                    'if __name__ == "__main__": only, since each process imports it.'
                ) from None
            raise
        super().__init__(len(env_fns), *answers[0])

    def _new_worker(self, i: int) -> Worker:
        counter = self.counters[i]
        return Worker(self.context, self.env_fns[i], counter.name, self.max_faults, self.step_timeout, self.start_timeout)

    # -- stepping ------------------------------------------------------------------------------------------------------

    def step_async(self, actions: np.ndarray) -> None:
        """
        :raises ValueError: for an action that is not finite
        :raises gymnasium.error.ClosedEnvironmentError: after ``close()``
        """
        self._check_open()
        for counter, action in zip(self.counters, actions, strict=True):
            check_finite_action(action, counter.name, counter.steps + 1)
        for i, action in enumerate(actions):
            if i not in self._lost:
                self._send_or_lose(i, "step", action)
        self.waiting = True

    def _check_open(self) -> None:
        """Or each process would be replaced, as one that died."""
        if self.closed:
            raise closed(type(self).__name__)

    def _send_or_lose(self, i: int, command: str, data: Any) -> None:
        try:
            self.workers[i].send(command, data)
        except WorkerFault as fault:
            self._replace(i, fault)

    def step_wait(self) -> VecEnvStepReturn:
        """:raises EnvironmentFaultError: after ``max_faults`` faults of one environment in a row"""
        self._check_open()
        self.waiting = False
        results = [self._result(i) for i in range(self.num_envs)]
        observations, rewards, dones, infos, self.reset_infos = map(list, zip(*results, strict=True))
        self._last = observations
        return self._stacked(observations), np.array(rewards, np.float32), np.array(dones, bool), infos

    def _result(self, i: int) -> tuple[Any, ...]:
        if i not in self._lost:
            try:
                result: tuple[Any, ...] = self.workers[i].receive()
                if FAULT in result[3]:
                    self.counters[i].steps += 1
                else:
                    self.counters[i].good(result[2])
                if earlier := self.counters[i].take():
                    result[3][FAULTS] = result[3].get(FAULTS, 0) + earlier
                return result
            except WorkerFault as fault:
                self._replace(i, fault)
        reason, observation, reset_info = self._lost.pop(i)
        info = {
            FAULT: reason,
            FAULTS: self.counters[i].take(),
            TRUNCATED: True,
            TERMINAL: self._last[i],
        }
        return observation, 0.0, True, info, reset_info

    def _replace(self, i: int, fault: WorkerFault) -> None:
        """Put a new worker in the place of one that died or hangs, at the beginning of an episode.

        :raises EnvironmentFaultError: if that fails again and again
        """
        reason = ""
        while True:
            self.workers[i].kill()
            reason = self.counters[i].bad(str(fault))
            try:
                self.workers[i] = self._new_worker(i)
                for name, value in self._set[i].items():
                    self._ask_worker(i, "set", (name, value))
                observation, reset_info = self._ask_worker(i, "reset", (self._next_seed(i), None))
                self._lost[i] = (reason, observation, reset_info)
                return
            except WorkerFault as again:
                fault = again

    def _next_seed(self, i: int) -> int | None:
        """Not the first one again: it would bring the same episodes back."""
        self._generations[i] += 1
        first = self._first_seeds[i]
        return None if first is None else int(np.random.SeedSequence([first, self._generations[i]]).generate_state(1)[0])

    def reset(self) -> VecEnvObs:
        """:raises EnvironmentFaultError: after ``max_faults`` faults of one environment in a row"""
        self._check_open()
        self.waiting = False
        self._lost.clear()
        results = []
        for i in range(self.num_envs):
            if self._seeds[i] is not None:
                self._first_seeds[i] = self._seeds[i]
            self._send_or_lose(i, "reset", (self._seeds[i], self._options[i]))
        for i in range(self.num_envs):
            try:
                results.append(self._lost.pop(i)[1:] if i in self._lost else self.workers[i].receive())
            except WorkerFault as fault:
                self._replace(i, fault)
                results.append(self._lost.pop(i)[1:])
        observations, self.reset_infos = map(list, zip(*results, strict=True))
        self._reset_seeds()
        self._reset_options()
        self._last = observations
        return self._stacked(observations)

    def _stacked(self, observations: list[Any]) -> VecEnvObs:
        keys, _, _ = obs_space_info(self.observation_space)
        if keys == [None]:
            return np.stack(observations)
        return dict_to_obs(self.observation_space, {key: np.stack([part[key] for part in observations]) for key in keys})

    # -- everything else -----------------------------------------------------------------------------------------------

    def _ask_worker(self, i: int, command: str, data: Any = None) -> Any:
        self.workers[i].send(command, data)
        return self.workers[i].receive()

    def _ask(self, command: str, data: Any = None, indices: VecEnvIndices = None) -> list[Any]:
        """One answer of each environment; a worker that died is replaced, and asked once more.

        Its episode ends with the next step.
        """
        self._check_open()
        answers = []
        for i in self._get_indices(indices):
            try:
                answers.append(self._ask_worker(i, command, data))
            except WorkerFault as fault:
                self._replace(i, fault)
                try:
                    answers.append(self._ask_worker(i, command, data))
                except WorkerFault as again:
                    raise EnvironmentFaultError(f"Environment {i}, {command} {data!r:.80}: {again}.") from None
        return answers

    def get_images(self) -> Sequence[np.ndarray | None]:
        """What ``render()`` of each environment gives."""
        if self.render_mode != "rgb_array":
            warnings.warn(f"The render mode is {self.render_mode!r}, images need 'rgb_array'.")
            return [None] * self.num_envs
        return self._ask("render")

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """:raises AttributeError: as of the environments, through all wrappers"""
        return self._ask("get", attr_name, indices)

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute; a worker that replaces another gets it, too."""
        self._ask("set", (attr_name, value), indices)
        for i in self._get_indices(indices):
            self._set[i][attr_name] = value

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method; what it changed is lost with its worker."""
        return self._ask("method", (method_name, method_args, method_kwargs), indices)

    def env_is_wrapped(self, wrapper_class: type[gymnasium.Wrapper], indices: VecEnvIndices = None) -> list[bool]:
        """Whether environments are wrapped in a class."""
        return self._ask("is_wrapped", wrapper_class, indices)

    def close(self) -> None:
        """End all workers; returns within 5 s, whatever they do. May be called again."""
        if not self.closed:
            self.closed = True
            end_all(self.workers, GRACE)


def _close(reference: weakref.ref[SupervisedVecEnv]) -> None:
    env = reference()
    if env is not None:
        env.close()


def make_supervised_vec_env(env_id: str | Callable[..., gymnasium.Env], n_envs: int = 1, **kwargs: Any) -> VecEnv:
    """SB3's ``make_vec_env`` with supervised processes.

    :param env_id: of the environment, or a function that makes it
    :param n_envs: number of processes
    :param kwargs: of :func:`stable_baselines3.common.env_util.make_vec_env`; its ``vec_env_kwargs`` are
        :class:`SupervisedVecEnv`'s
    :raises ValueError: for fewer than one process
    :raises UnknownNameError: for another keyword
    """
    check_integer("n_envs", n_envs, 1)
    known = inspect.signature(make_vec_env).parameters.keys() | {"n_envs"}
    check_keys("arguments", kwargs, known - {"vec_env_cls"}, "make_supervised_vec_env")
    return make_vec_env(env_id, n_envs, vec_env_cls=SupervisedVecEnv, **kwargs)  # type: ignore[arg-type]
