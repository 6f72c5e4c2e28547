"""A dm_control task as a gymnasium environment.

One class, from the action to the observation, in place of a stack of wrappers: rescale the action, hold it for some control
steps, sum their rewards, observe once. How it observes is a subclass's affair: ``pixel_env`` through a camera, ``state_env``
by dm_control's own numbers. The physics steps the same for all of them. Shimmy stands between it and dm_control and does the
seeding and the translation of dm_control's time steps. Importing Shimmy imports GLFW, whose library opens no other library
before a window is wanted: states need no OpenGL.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium import spaces
from gymnasium.error import ClosedEnvironmentError, ResetNeeded

from sb3_dreamer_urlb.envs.domain_rewards import KEY, DomainRewards
from sb3_dreamer_urlb.envs.options import PixelOptions
from sb3_dreamer_urlb.envs.rendering import claim_renderer, load_physics
from sb3_dreamer_urlb.number_checks import is_integer

load_physics()

from dm_control import composer  # noqa: E402 - without OpenGL, see load_physics
from dm_control.rl import control  # noqa: E402
from shimmy.dm_control_compatibility import DmControlCompatibilityV0  # noqa: E402 - imports dm_control

if TYPE_CHECKING:
    from sb3_dreamer_urlb.envs.perturbed_control import PerturbedControl

_FAST_SHADOW_MAP = 512  # texels a side; dm_control's own is 2048, composer's 4096
_UNLIMITED = 1e10  # what dm_control gives as the bound of an actuator that has none (mjMAXVAL)


class ShimmyEnv(DmControlCompatibilityV0):
    """Shimmy's environment. It writes ``render_fps`` into its class's ``metadata``: give it a dict of its own to spoil."""

    metadata: ClassVar[dict[str, Any]] = dict(DmControlCompatibilityV0.metadata)


class ControlEnv(gymnasium.Env[Any, npt.NDArray[np.float32]]):
    """A dm_control environment, however it is observed.

    Actions are float32 (A,) in [-1, 1], mapped linearly to the task's bounds; values outside go through and MuJoCo clamps
    them. The reward is the sum over the control steps of one action, a float. ``info["task_reward"]`` holds it too, also
    when ``reward_free``. With ``domain_rewards``, ``info["domain_rewards"]`` has such a sum for each task of the domain.

    ``reset(seed=s)`` seeds everything the task draws; without a seed its stream goes on (a fresh one starts from the
    system's entropy). It does not seed ``action_space``.

    :param control_env: a bare environment of dm_control's suite or composer (Shimmy cannot seed a wrapped composer one)
    :param options: how it is shown
    :param domain: kept as ``domain``
    :param task: kept as ``task``
    :param never_terminates: whether episodes only ever end by the time limit; kept as ``never_terminates``
    :raises ValueError: if the task has no such camera
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"]}  # noqa: RUF012 - gymnasium's own declaration

    #: Agent steps of an episode that runs to its time limit; None where the task has no limit.
    max_episode_steps: int | None

    def __init__(
        self,
        control_env: control.Environment | composer.Environment,
        options: PixelOptions,
        *,
        domain: str,
        task: str,
        never_terminates: bool = False,
    ) -> None:
        self.domain, self.task = domain, task
        self.never_terminates = never_terminates
        self.reward_free = options.reward_free
        self.action_repeat = int(options.action_repeat)
        self.max_episode_steps = _episode_length(control_env, self.action_repeat)
        self.render_mode = options.render_mode
        step_seconds = control_env.control_timestep() * self.action_repeat
        # A new dict: the class's own is shared by all instances, whose frame rates differ.
        self.metadata = {**self.metadata, "render_fps": 1 / step_seconds}

        self._options = options
        self._control = control_env
        self._check_camera(options.camera)
        self._shimmy = ShimmyEnv(control_env)
        #: what steps it in place of itself, if it is perturbed: see ``perturbed_control``
        self.perturbed: PerturbedControl | None = None
        #: tells what each task of the domain would pay; None where nobody asks
        self.domain_rewards: DomainRewards | None = None
        self._was_reset, self._episode_over, self._closed = False, True, False

        spec = control_env.action_spec()
        limited = (np.abs(spec.minimum) < _UNLIMITED) & (np.abs(spec.maximum) < _UNLIMITED)
        self._low, self._high = np.where(limited, spec.minimum, -1.0), np.where(limited, spec.maximum, 1.0)
        self.action_space = spaces.Box(-1.0, 1.0, spec.shape, np.float32)
        self.observation_space = self._space()

    @abstractmethod
    def _space(self) -> spaces.Space[Any]:
        """What :meth:`_observe` returns."""

    @abstractmethod
    def _observe(self, observed: dict[str, Any]) -> Any:
        """The present state as the agent sees it, in new arrays.

        :param observed: dm_control's own observation, an array a part
        """

    def perturb(self, perturbed: PerturbedControl) -> None:
        """Step through this one from the next reset on; an episode that is running is over.

        :param perturbed: stands around the same bare environment
        :raises gymnasium.error.ClosedEnvironmentError: after ``close()``
        """
        self._refuse_closed()
        self.perturbed = perturbed
        self._shimmy = ShimmyEnv(perturbed)
        self._episode_over = True

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start an episode.

        :param seed: 0 to 2**32 - 1, or None to go on with the stream
        :param options: ignored
        :return: the first observation and an empty info
        :raises ValueError: for any other seed
        :raises gymnasium.error.ClosedEnvironmentError: after ``close()``
        :raises dm_control.rl.control.PhysicsError: if the simulation diverges
        """
        self._refuse_closed()
        if seed is not None and not (is_integer(seed) and 0 <= seed < 2**32):
            raise ValueError(f"{self}: seed={seed!r}: expected None or an int from 0 to {2**32 - 1}")
        seed = None if seed is None else int(seed)
        super().reset(seed=seed)
        if seed is not None and self.perturbed is not None:
            self.perturbed.seed(seed)
        with self._named_physics_errors():
            observed, _ = self._shimmy.reset(seed=seed)
        self._prepare_renderer()
        self._was_reset, self._episode_over = True, False
        return self._observe(observed), {}

    def step(self, action: npt.NDArray[np.float32]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Hold an action for ``action_repeat`` control steps, or until the episode ends.

        :param action: finite, (A,)
        :return: observation, reward, terminated, truncated, info
        :raises ValueError: if the action has another shape, or holds NaN or infinity
        :raises gymnasium.error.ResetNeeded: before the first ``reset()``, and after the end of an episode
        :raises gymnasium.error.ClosedEnvironmentError: after ``close()``
        :raises dm_control.rl.control.PhysicsError: if the simulation diverges; the episode is then over
        """
        self._refuse_closed()
        if self._episode_over:
            raise ResetNeeded(f"{self}: call reset() before step(): no episode is running.")
        control_action = self._to_control(action)
        task_reward, terminated, truncated = 0.0, False, False
        others: dict[str, float] = {}
        for _ in range(self.action_repeat):
            with self._named_physics_errors():
                # dm_control's time limits leave the discount at 1: Shimmy calls that truncated.
                observed, reward, terminated, truncated, _ = self._shimmy.step(control_action)
            task_reward += float(reward)
            if self.domain_rewards is not None:
                paid = self.domain_rewards((self.perturbed or self._control).physics)
                others = {name: others.get(name, 0.0) + value for name, value in paid.items()}
            if terminated or truncated:
                self._episode_over = True
                break
        observation = self._observe(observed)
        reward = 0.0 if self.reward_free else task_reward
        info: dict[str, Any] = {"task_reward": task_reward}
        if self.domain_rewards is not None:
            info[KEY] = others
        return observation, reward, terminated, truncated, info

    def render(self) -> npt.NDArray[np.uint8] | None:
        """The present state, drawn for people: of ``render_size``, whatever the size of the observations.

        :return: uint8 (render_size, render_size, 3), or None without a render mode
        :raises gymnasium.error.ResetNeeded: before the first ``reset()``
        :raises gymnasium.error.ClosedEnvironmentError: after ``close()``
        """
        self._refuse_closed()
        if self.render_mode is None:
            gymnasium.logger.warn(f"{self} was made without a render mode: nothing to render. Use 'rgb_array'.")
            return None
        if not self._was_reset:
            raise ResetNeeded(f"{self}: call reset() before render().")
        return self._picture(self._options.render_size)

    def close(self) -> None:
        """Free the simulation and its OpenGL context. May be called again."""
        if not self._closed:
            self._closed = self._episode_over = True
            self._shimmy.close()

    def _refuse_closed(self) -> None:
        if self._closed:
            raise ClosedEnvironmentError(f"{self} was closed: make a new one.")

    def __getstate__(self) -> dict[str, Any]:
        """For copies and for pickle.

        :raises TypeError: for tasks of composer (Jaco, manipulation), whose models dm_control cannot copy
        """
        if isinstance(self._control, composer.Environment):
            raise TypeError(f"{self} can be neither pickled nor copied: dm_control cannot copy its model. Make it again.")
        return self.__dict__

    def __str__(self) -> str:
        registered = f" ({self.spec.id})" if self.spec else ""
        return f"<{type(self).__name__} {self.domain}-{self.task}{registered}>"

    def _to_control(self, action: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
        """From [-1, 1] to the task's own bounds; a value outside ends outside, and MuJoCo clamps it.

        Bounds and result are rounded to the action's own precision, float32 for an agent's, because the benchmark's code
        does so: without it, the quadruped's rewards move by 3e-5 within 50 control steps.

        :param action: (A,)
        :return: float64 (A,)
        """
        given = np.asarray(action)
        if given.shape != self.action_space.shape:
            raise ValueError(f"{self}: action {action!r} of shape {given.shape}, expected {self.action_space.shape}")
        if not np.can_cast(given.dtype, np.float64, "same_kind"):
            raise ValueError(f"{self}: action {action!r}, expected numbers")
        values = given.astype(np.float64)
        if not np.isfinite(values).all():
            raise ValueError(f"{self}: action {action!r} is not finite")
        precision = np.float32 if given.dtype == np.float32 else np.float64
        low, high = self._low.astype(precision), self._high.astype(precision)
        return (low + (values + 1) / 2 * (high - low)).astype(precision).astype(np.float64)

    def _prepare_renderer(self) -> None:
        """Set what the OpenGL context is built from. It is built at the model's first frame, and composer compiles a new
        model each episode.
        """
        visual = self._control.physics.model.vis
        largest = max(self._options.image_size, self._options.render_size)
        visual.global_.offwidth = max(visual.global_.offwidth, largest)
        visual.global_.offheight = max(visual.global_.offheight, largest)
        if self._options.fast_render:
            visual.quality.shadowsize = _FAST_SHADOW_MAP

    def _picture(self, size: int) -> npt.NDArray[np.uint8]:
        """Draw the present state.

        :param size: height and width
        :raises RenderingBackendError: if nothing can draw here
        :return: uint8 (size, size, 3), C-contiguous (dm_control hands out an upside-down view)
        """
        claim_renderer()
        image = self._control.physics.render(height=size, width=size, camera_id=self._options.camera)
        return np.ascontiguousarray(image)

    def _check_camera(self, camera: int | str) -> None:
        """:raises ValueError: if the model has no such camera"""
        model = self._control.physics.model
        names = [model.id2name(index, "camera") for index in range(model.ncam)]
        if camera not in names and camera not in range(-1, model.ncam):
            raise ValueError(
                f"camera={camera!r}: {self.domain}-{self.task} has the ids 0 to {model.ncam - 1}, "
                f"by name {', '.join(names)} (and -1, MuJoCo's free camera)"
            )

    @contextmanager
    def _named_physics_errors(self) -> Iterator[None]:
        """End the episode where the simulation diverges (NaN, infinity), and say whose it was."""
        try:
            yield
        except control.PhysicsError as error:
            self._episode_over = True
            raise control.PhysicsError(f"{self}: {error}") from error


def _episode_length(control_env: control.Environment | composer.Environment, action_repeat: int) -> int | None:
    """Agent steps until the time limit; the last one may hold its action for fewer control steps.

    dm_control keeps the limit in private attributes only: the suite in control steps, composer in seconds.

    :param control_env: the bare dm_control environment
    :param action_repeat: control steps an agent step
    :return: None where there is no limit
    """
    if isinstance(control_env, composer.Environment):
        control_steps = control_env._time_limit / control_env.control_timestep()
    else:
        control_steps = control_env._step_limit
    if math.isinf(control_steps):
        return None
    return -(-math.ceil(round(control_steps, 6)) // action_repeat)
