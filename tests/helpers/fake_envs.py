"""A cheap environment whose images count, so that a test knows which step it is looking at."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces


class UndrawnEnv(gymnasium.Wrapper):
    """Of a task whose drawing package is not installed, which gymnasium finds out when it draws."""

    def render(self) -> Any:
        raise gymnasium.error.DependencyNotInstalled("pygame is not installed")


class CounterEnv(gymnasium.Env):
    """Pixels (0, 0) and (0, 1) hold the number of frames drawn since the environment was made, low byte first.

    :param length: steps an episode, or one number for each episode, used in turn; None never ends one
    :param size: height and width of the image
    :param channels: of the image
    :param action_space: Box
    :param terminates: end episodes by termination instead of truncation
    :param rewards: reward of each step of an episode, used in turn
    :param attributes: set on the environment (``action_repeat``, ``domain``, ``never_terminates``, ...)
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012

    def __init__(
        self,
        length: int | Sequence[int] | None = 20,
        *,
        size: int = 16,
        channels: int = 3,
        action_space: spaces.Space | None = None,
        observation_space: spaces.Space | None = None,
        terminates: bool = False,
        rewards: Sequence[float] = (0.0, 1.0, 0.5),
        render_mode: str | None = "rgb_array",
        **attributes: Any,
    ):
        self.observation_space = observation_space or spaces.Box(0, 255, (size, size, channels), np.uint8)
        self.action_space = action_space or spaces.Box(-1, 1, (2,), np.float32)
        self.lengths = itertools.cycle([length] if length is None or isinstance(length, int) else length)
        self.terminates = terminates
        self.rewards = rewards
        self.render_mode = render_mode
        self.frames = 0
        self.resets = 0
        #: the actions of each episode, as they arrived
        self.received: list[list[np.ndarray]] = []
        for name, value in attributes.items():
            setattr(self, name, value)

    def _observation(self) -> Any:
        space = self.observation_space
        if not isinstance(space, spaces.Box) or space.dtype != np.uint8:
            return space.sample()
        image = np.full(space.shape, 7 * self.frames % 256, np.uint8)
        image[0, 0], image[0, 1] = self.frames % 256, self.frames // 256
        self.frames += 1
        return image

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.t, self.length = 0, next(self.lengths)
        self.resets += 1
        self.received.append([])
        return self._observation(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.received[-1].append(np.array(action))
        reward = self.rewards[self.t % len(self.rewards)]
        self.t += 1
        done = self.t == self.length
        return self._observation(), reward, done and self.terminates, done and not self.terminates, {}

    def render(self) -> np.ndarray:
        return np.full((32, 32, 3), 3 * self.t % 256, np.uint8)


def counter(observation: np.ndarray) -> np.ndarray:
    """What channels-first images (..., C, height, width) count."""
    return observation[..., 0, 0, 0].astype(int) + 256 * observation[..., 0, 0, 1].astype(int)
