"""Replay of whole episodes, drawn as sequences (spec/algorithms §3, spec/reliability "Replay").

Row t of an episode holds observation t with the action and the reward that *led to* it. Each environment writes its own
stream, so episodes may end at different times; only finished episodes are drawn, and a sequence never leaves its episode.
"""

from __future__ import annotations

from collections import deque
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_dreamer_urlb.env_steps import is_fault
from sb3_dreamer_urlb.types import SequenceBatch


class Episode:
    """Contiguous rows that grow while the episode is open.

    :param observation: the episode's first observation
    :param action_size: A
    :param skill: under which the first action is chosen, (W,)
    """

    COLUMNS: ClassVar[tuple[str, ...]] = ("observation", "action", "reward", "is_terminal", "skill")
    length: int

    def __init__(self, observation: np.ndarray, action_size: int, skill: np.ndarray):
        capacity = 128
        self.observation = np.empty((capacity, *observation.shape), observation.dtype)
        self.action = np.zeros((capacity, action_size), np.float32)
        self.reward = np.zeros(capacity, np.float32)
        self.is_terminal = np.zeros(capacity, bool)
        self.skill = np.zeros((capacity, len(skill)), np.float32)
        self.length = 1
        self.observation[0] = observation
        self.skill[0] = skill

    @classmethod
    def of(cls, columns: dict[str, np.ndarray]) -> Episode:
        """A finished episode of given rows, for example from a file.

        :param columns: rows of each of ``COLUMNS``
        """
        episode = cls.__new__(cls)
        episode.__dict__.update(columns, length=len(columns["reward"]))
        return episode

    def __len__(self) -> int:
        return self.length

    def append(self, observation: np.ndarray, action: np.ndarray, reward: float, is_terminal: bool, skill: np.ndarray) -> None:
        """Add the row that ``action``, chosen under ``skill``, led to."""
        if self.length == len(self.reward):
            self._resize(2 * self.length)
        t = self.length
        self.observation[t] = observation
        self.action[t] = action
        self.reward[t] = reward
        self.is_terminal[t] = is_terminal
        self.skill[t] = skill
        self.length += 1

    def finish(self) -> Episode:
        """Give unused memory back."""
        self._resize(self.length)
        return self

    def _resize(self, capacity: int) -> None:
        for name in self.COLUMNS:
            old = getattr(self, name)
            new = np.empty((capacity, *old.shape[1:]), old.dtype)
            new[: self.length] = old[: self.length]
            setattr(self, name, new)


class SequenceReplayBuffer(ReplayBuffer):
    """In-memory replay of episodes, one stream per environment.

    Memory is taken as episodes arrive. When more than ``buffer_size`` rows are held, whole episodes go, oldest first.

    :param buffer_size: rows (agent steps, plus one a episode) to hold
    :param observation_space: of one environment, channels first
    :param action_space: of one environment
    :param device: where batches go
    :param n_envs: number of streams
    :param batch_length: T, rows a sequence
    :param max_episode_rows: longer episodes are stored in pieces of this many rows, so that endless ones are drawn too
    :param seed: of the sampler
    :param phase: name of the phase that filled it; a fine-tuning refuses a pre-training's buffer
    :param skill_size: W, size of the skills to store with each row, 0 for none
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        device: th.device | str = "auto",
        n_envs: int = 1,
        *,
        batch_length: int,
        max_episode_rows: int = 5000,
        seed: int | None = None,
        phase: str = "",
        skill_size: int = 0,
    ):
        # ReplayBuffer's own constructor would allocate the whole buffer at once, in lock-step arrays.
        BaseBuffer.__init__(self, buffer_size, observation_space, action_space, device, n_envs)
        if batch_length > min(buffer_size, max_episode_rows):
            raise ValueError(
                f"batch_length={batch_length} must not exceed buffer_size={buffer_size} "
                f"and max_episode_rows={max_episode_rows}."
            )
        self.buffer_size = buffer_size
        self.batch_length = batch_length
        # A piece must fit into the buffer, or it would be all that is ever held.
        self.max_episode_rows = min(max_episode_rows, buffer_size)
        self.phase = phase
        self.skill_size = skill_size
        self.rng = np.random.default_rng(seed)
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self.episodes: deque[Episode] = deque()
        self.open: list[Episode | None] = [None] * self.n_envs
        self.finished_rows = 0
        self.finished_count = 0
        self.longest = 0
        #: episodes that went; episode i of those held is number ``evicted + i`` of all
        self.evicted = 0

    def size(self) -> int:
        """Rows held, those of open episodes included."""
        return self.finished_rows + sum(len(episode) for episode in self.open if episode is not None)

    # -- writing -------------------------------------------------------------------------------------------------------

    def add(  # type: ignore[override]
        self,
        obs: np.ndarray,
        next_obs: np.ndarray,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
        skill: np.ndarray | None = None,
    ) -> None:
        """Store one step of every environment.

        :param obs: what was seen, (n_envs, …); it is a row of its own only where an episode begins
        :param next_obs: what followed, (n_envs, …); the true last observation where ``done``, not the next episode's first
        :param action: as executed, in [-1, 1], (n_envs, A)
        :param reward: (n_envs,)
        :param done: (n_envs,)
        :param infos: ``TimeLimit.truncated`` tells truncation from termination; a step marked as a fault is not stored, and
            ends the episode before it as truncated
        :param skill: that each action followed, (n_envs, W); None without skills
        :raises ValueError: for skills of another shape
        """
        skill = np.zeros((self.n_envs, 0), np.float32) if skill is None else skill
        if skill.shape != (self.n_envs, self.skill_size):
            raise ValueError(f"Skills must have the shape {(self.n_envs, self.skill_size)}, got {skill.shape}.")
        for i in range(self.n_envs):
            if is_fault(infos[i]):
                self._finish(i)
                continue
            episode = self.open[i]
            if episode is None:
                episode = self.open[i] = Episode(np.asarray(obs[i]), self.action_dim, skill[i])
            terminal = bool(done[i]) and not infos[i].get("TimeLimit.truncated", False)
            episode.append(next_obs[i], action[i].reshape(-1), float(reward[i]), terminal, skill[i])
            if done[i] or len(episode) >= self.max_episode_rows:
                self._finish(i)

    def close_streams(self) -> None:
        """End the open episodes as truncated: the environments were reset behind their back."""
        for i in range(self.n_envs):
            self._finish(i)

    def _finish(self, i: int) -> None:
        episode, self.open[i] = self.open[i], None
        if episode is None:
            return
        self.finished_count += 1
        self.longest = max(self.longest, len(episode))
        if len(episode) < self.batch_length:
            return
        self.episodes.append(episode.finish())
        self.finished_rows += len(episode)
        self.evict()

    def evict(self) -> None:
        """Let the oldest episodes go until ``buffer_size`` is kept."""
        while self.finished_rows > self.buffer_size and len(self.episodes) > 1:
            self.finished_rows -= len(self.episodes.popleft())
            self.evicted += 1

    def columns(self) -> dict[str, tuple[th.dtype, tuple[int, ...]]]:
        """What a row of an episode consists of: name → type and shape, for files."""
        first = np.zeros(self.obs_shape, self.observation_space.dtype)
        episode = Episode(first, self.action_dim, np.zeros(self.skill_size, np.float32))
        rows = {name: getattr(episode, name) for name in Episode.COLUMNS}
        return {name: (th.from_numpy(array[:0]).dtype, array.shape[1:]) for name, array in rows.items()}

    # -- reading -------------------------------------------------------------------------------------------------------

    def can_sample(self) -> bool:
        """Whether any finished episode is long enough."""
        return len(self.episodes) > 0

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> SequenceBatch:  # type: ignore[override]
        """Draw sequences: an episode uniformly, then a start uniformly (spec/algorithms §3).

        :param batch_size: B
        :param env: normalises rewards if given
        :return: (B, T, …) on ``device``
        :raises ValueError: if no finished episode has ``batch_length`` rows
        """
        if not self.can_sample():
            raise ValueError(f"No finished episode has batch_length={self.batch_length} rows yet.")
        length = self.batch_length
        first = self.episodes[0]
        observation = np.empty((batch_size, length, *first.observation.shape[1:]), first.observation.dtype)
        action = np.empty((batch_size, length, self.action_dim), np.float32)
        reward = np.empty((batch_size, length), np.float32)
        is_terminal = np.empty((batch_size, length), bool)
        skill = np.empty((batch_size, length, self.skill_size), np.float32)
        for b, index in enumerate(self.rng.integers(len(self.episodes), size=batch_size)):
            episode = self.episodes[index]
            start = self.rng.integers(len(episode) - length + 1)
            rows = slice(start, start + length)
            observation[b] = episode.observation[rows]
            action[b] = episode.action[rows]
            reward[b] = episode.reward[rows]
            is_terminal[b] = episode.is_terminal[rows]
            skill[b] = episode.skill[rows]
        is_first = np.zeros((batch_size, length), bool)
        is_first[:, 0] = True
        reward = self._normalize_reward(reward, env).astype(np.float32, copy=False)
        parts = [observation, action, reward, is_first, is_terminal, *([skill] if self.skill_size else [])]
        return SequenceBatch(*(th.from_numpy(part).to(self.device, non_blocking=True) for part in parts))
