"""Replay of single steps with stacked frames and n-step returns, on the episodes, streams and stores of the sequences' replay.

Each frame is stored once, as the environment gave it, and stacked when it is drawn. Stable-Baselines3's own n-step buffer
holds stacked observations, and each of them twice: six times the memory for stacks of three.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecNormalize

from sb3_dreamer_urlb.number_checks import check_integer
from sb3_dreamer_urlb.replay import gathering, stores
from sb3_dreamer_urlb.replay.device_store import OnItsWay
from sb3_dreamer_urlb.replay.episode_buffer import MAX_EPISODE_ROWS
from sb3_dreamer_urlb.replay.rows import observation_of
from sb3_dreamer_urlb.replay.sampling import BY_ROW, Pieces
from sb3_dreamer_urlb.replay.sequence_buffer import SequenceReplayBuffer
from sb3_dreamer_urlb.replay.windows import draw_windows
from sb3_dreamer_urlb.types import Observation, StepBatch, map_observation


class NStepFrameReplayBuffer(SequenceReplayBuffer):
    """Draws steps of finished episodes uniformly, each with its stack of frames and its n-step return.

    While none is finished, the open ones are drawn as they stand, so that learning begins when it is due however long an
    episode takes. Endless ones are finished in pieces of ``max_episode_rows``.

    Stacks begin anew with each episode, whose first frame fills what is missing, and so do they with each such piece: of its
    first frame_stack - 1 steps, the agent saw the frames before, too. A return ends with its episode: with fewer
    than n rewards, and with the value of the true last observation where the episode was truncated, without one where it
    terminated.

    :param buffer_size: see :class:`~sb3_dreamer_urlb.SequenceReplayBuffer`, also for what is not named here
    :param observation_space: of one frame
    :param action_space: of one environment
    :param device: where batches go
    :param n_envs: number of streams
    :param frame_stack: frames an observation has
    :param n_steps: n
    :param gamma: discount of a step
    :param max_episode_rows: see above
    :param kwargs: of :class:`~sb3_dreamer_urlb.SequenceReplayBuffer`
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        device: th.device | str = "auto",
        n_envs: int = 1,
        *,
        frame_stack: int = 3,
        n_steps: int = 3,
        gamma: float = 0.99,
        max_episode_rows: int = MAX_EPISODE_ROWS,
        **kwargs: Any,
    ):
        length = frame_stack + n_steps
        check_integer("max_episode_rows", max_episode_rows, 1)
        for name, rows in (("buffer_size", buffer_size), ("max_episode_rows", max_episode_rows)):
            if length > rows:
                raise ValueError(f"{name}={rows} must not be smaller than frame_stack + n_steps, {length} rows.")
        drawn: dict[str, Any] = {"batch_length": length, "sampling": BY_ROW, "max_episode_rows": max_episode_rows}
        super().__init__(buffer_size, observation_space, action_space, device, n_envs, **drawn, **kwargs)
        self.frame_stack = frame_stack
        self.n_steps = n_steps
        self.gamma = gamma

    def check_lengths(self, batch_length: int) -> None:
        """Rows are stacked and summed when they are drawn: those of any other ``frame_stack`` and ``n_steps`` will do."""

    def can_sample(self) -> bool:
        """Whether a step was made."""
        self.attach()
        return len(self._drawn_from()) > 0

    @property
    def waits_for(self) -> str:
        """What there has to be before :meth:`can_sample`, for people."""
        return "a first step"

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> StepBatch:  # type: ignore[override]
        """Draw steps uniformly.

        :param batch_size: B
        :param env: normalises observations and rewards if given
        :return: on ``device``
        :raises ValueError: if no step was made
        """
        if not self.can_sample():
            raise ValueError("No step was made yet: there is nothing to draw.")
        columns = self._drawn(batch_size) if env is None else self._drawn_and_normalized(batch_size, env)
        return steps_of(columns, self.frame_stack, self.n_steps, self.gamma)

    def _pieces(self, rng: np.random.Generator, batch_size: int) -> Iterator[Pieces]:
        return draw_windows(rng, self._drawn_from(), self.frame_stack - 1, self.n_steps, batch_size)

    def _drawn_from(self) -> Sequence[Any]:
        if len(self.episodes) > 0:
            episodes: Sequence[Any] = self.episodes
            return episodes
        begun = [episode for episode in self.open if episode is not None]
        return [OnItsWay(episode, self.device) for episode in begun] if self.store == stores.DEVICE else begun

    def _moment(self, batch_size: int) -> tuple[Any, ...]:
        begun = () if len(self.episodes) > 0 else tuple(map(len, self._drawn_from()))
        return *super()._moment(batch_size), begun


def steps_of(columns: gathering.Tensors, frame_stack: int, n_steps: int, gamma: float) -> StepBatch:
    """From windows of rows to steps, on the windows' device; nothing waits for it.

    :param columns: (B, frame_stack + n_steps, …) by name
    :param frame_stack: s
    :param n_steps: n
    :param gamma: discount of a step
    """
    after = slice(frame_stack, None)
    # A row after the episode's last is a piece of its own, its last row once more.
    inside = ~columns[gathering.IS_FIRST][:, after]
    steps = inside.sum(1)
    discounts = gamma ** th.arange(n_steps, device=inside.device)
    reward = (columns["reward"][:, after] * inside * discounts).sum(1)
    terminal = (columns["is_terminal"][:, after] & inside).any(1)
    rows = steps.unsqueeze(1) + th.arange(frame_stack, device=steps.device)
    batch = th.arange(len(rows), device=rows.device).unsqueeze(1)

    def first(frames: th.Tensor) -> th.Tensor:
        return frames[:, :frame_stack]

    def last(frames: th.Tensor) -> th.Tensor:
        return frames[batch, rows]

    observation: Observation = observation_of(columns)
    return StepBatch(
        map_observation(first, observation),
        columns["action"][:, frame_stack],
        reward,
        gamma**steps * ~terminal,
        map_observation(last, observation),
    )
