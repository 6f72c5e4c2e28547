"""Episodes as a replay keeps them: written by one stream an environment, the finished ones in memory, on a device or on disk.

Row t of an episode holds observation t with the action and the reward that *led to* it. Each environment writes its own
stream, so episodes may end at different times.
"""

from __future__ import annotations

import math
import os
import warnings
from collections import deque
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer

from sb3_dreamer_urlb.envs.domain_rewards import KEY
from sb3_dreamer_urlb.envs.env_steps import is_fault
from sb3_dreamer_urlb.envs.info_keys import TRUNCATED
from sb3_dreamer_urlb.number_checks import check_integer
from sb3_dreamer_urlb.replay import stores
from sb3_dreamer_urlb.replay.device_store import DeviceEpisode
from sb3_dreamer_urlb.replay.episode import Episode
from sb3_dreamer_urlb.replay.rows import RawObservation
from sb3_dreamer_urlb.spaces.actions import make_actions

if TYPE_CHECKING:
    from sb3_dreamer_urlb.replay.lmdb_store import LmdbStore

#: longer episodes are stored in pieces, where nobody says otherwise
MAX_EPISODE_ROWS = 5000


def _zeros(space: spaces.Space[Any]) -> np.ndarray:
    assert space.shape is not None
    return np.zeros(space.shape, space.dtype)


class EpisodeBuffer(ReplayBuffer):
    """What is written, and what is held; a subclass draws from it.

    Memory is taken as episodes arrive. When more than ``buffer_size`` rows are held, whole episodes go, oldest first.

    Its arguments are those of :class:`~sb3_dreamer_urlb.SequenceReplayBuffer` that say what is kept, and where.

    :raises ValueError: for arguments that do not fit
    :raises ModuleNotFoundError: if lmdb is not installed
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        device: th.device | str,
        n_envs: int,
        *,
        max_episode_rows: int,
        phase: str,
        skill_size: int,
        tasks: Sequence[str],
        store: str,
        path: str | os.PathLike[str] | None,
        map_size: int | None,
    ):
        # ReplayBuffer's own constructor would allocate the whole buffer at once, in lock-step arrays.
        BaseBuffer.__init__(self, buffer_size, observation_space, action_space, device, n_envs)
        check_integer("max_episode_rows", max_episode_rows, 1)
        self.buffer_size = buffer_size
        # A piece must fit into the buffer, or it would be all that is ever held.
        self.max_episode_rows = min(max_episode_rows, buffer_size)
        self.phase = phase
        self.skill_size = skill_size
        self.tasks = tuple(tasks)
        stores.check_store(store, path, map_size)
        self.disk: LmdbStore | None = None
        self.path = None if path is None else Path(path) / (phase or "replay")
        self.map_size = map_size
        #: name of the store, never ``"auto"``
        self.store = stores.choose(store, self.device, buffer_size * self.row_bytes())
        device_of_rows = self.device if self.store == stores.DEVICE else None
        stores.warn_if_too_large(buffer_size, self.row_bytes(), self.path, device_of_rows)
        self._forget()

    def row_bytes(self) -> int:
        """Bytes of one row."""
        return sum(dtype.itemsize * math.prod(shape) for dtype, shape in self.columns().values())

    def reset(self) -> None:
        """Forget everything, also on disk."""
        self._before_change()
        self._forget()
        if self.path is not None:
            self.attach(taking_over=True)
            self.roll_back(0, {"evicted": 0, "finished_count": 0, "longest": 0})

    def _shortest(self) -> int:
        """Rows that a finished episode must have to be kept."""
        return 1

    def _before_change(self) -> None:
        """What is held is about to be other episodes, or in another place: for whoever reads in a thread."""

    def _forget(self) -> None:
        #: finished episodes, oldest first
        self.episodes: Any = deque() if self.disk is None else self.disk
        self.open: list[Episode | None] = [None] * self.n_envs
        self.finished_rows = 0
        self.finished_count = 0
        self.longest = 0
        #: episodes that went; episode i of those held is number ``evicted + i`` of all
        self.evicted = 0

    def attach(self, taking_over: bool = False) -> None:
        """Open the store on disk, if there is to be one. Not before it is needed: who only looks at a model leaves it alone.

        :param taking_over: the rows of an earlier run are expected
        :raises ReplayStoreError: if it cannot be used
        """
        if self.path is None or self.disk is not None:
            return
        from sb3_dreamer_urlb.replay.lmdb_store import HELD_ROWS, SPARE, LmdbStore

        rows = self.buffer_size + self.max_episode_rows + min(self.buffer_size, HELD_ROWS)
        # 1.3: pages that are not full.
        map_size = self.map_size or int(1.3 * rows * self.row_bytes()) + SPARE
        layout = {name: (th.empty(0, dtype=dtype).numpy().dtype, shape) for name, (dtype, shape) in self.columns().items()}
        self.episodes = self.disk = LmdbStore(self.path, layout, {"phase": self.phase}, map_size)
        self._follow_disk()
        if self.finished_rows and not taking_over:
            warnings.warn(f"{self.path} holds {self.finished_rows} rows of an earlier run: they will be drawn, too.")

    def _follow_disk(self) -> None:
        assert self.disk is not None
        self.evicted, self.finished_rows = self.disk.first, sum(self.disk.lengths)
        self.finished_count, self.longest = self.disk.counters["finished_count"], self.disk.counters["longest"]

    def roll_back(self, end: int, counters: dict[str, int]) -> None:
        """Bring the store on disk back to a checkpoint; warns if episodes of it are gone.

        :param end: number of the first episode that goes
        :param counters: ``evicted``, ``finished_count`` and ``longest`` as of the checkpoint
        """
        assert self.disk is not None
        self._before_change()
        numbers = {name: counters[name] for name in ("finished_count", "longest")}
        lost = self.disk.roll_back(end, counters["evicted"], numbers)
        if lost:
            warnings.warn(
                f"{self.path}: {lost} episodes that the checkpoint drew from were driven out after it, for map_size="
                f"{self.disk.map_size} bytes had no room for them. The run goes on, but not bit for bit."
            )
        self._follow_disk()

    def release(self) -> None:
        """A checkpoint is complete: what left the store on disk before it may go from the file, too."""
        if self.disk is not None:
            # LMDB moves the file's memory for it, in which the thread may be reading.
            self._before_change()
            self.disk.release(self.evicted)

    def size(self) -> int:
        """Rows held, those of open episodes included."""
        self.attach()
        return self.finished_rows + sum(len(episode) for episode in self.open if episode is not None)

    # -- writing -------------------------------------------------------------------------------------------------------

    def add(
        self,
        obs: RawObservation,
        next_obs: RawObservation,
        action: np.ndarray,
        reward: np.ndarray,
        done: np.ndarray,
        infos: list[dict[str, Any]],
        skill: np.ndarray | None = None,
    ) -> None:
        """Store one step of every environment.

        :param obs: what was seen, (n_envs, …), by name for Dicts; it is a row of its own only where an episode begins
        :param next_obs: what followed, (n_envs, …); the true last observation where ``done``, not the next episode's first
        :param action: as executed, in [-1, 1] or one-hot, (n_envs, A)
        :param reward: (n_envs,)
        :param done: (n_envs,)
        :param infos: ``TimeLimit.truncated`` tells truncation from termination; a step marked as a fault is not stored, and
            ends the episode before it as truncated
        :param skill: that each action followed, (n_envs, W); None without skills
        :raises ValueError: for skills of another shape
        """
        self.attach()
        skill = np.zeros((self.n_envs, 0), np.float32) if skill is None else skill
        if skill.shape != (self.n_envs, self.skill_size):
            raise ValueError(f"Skills must have the shape {(self.n_envs, self.skill_size)}, got {skill.shape}.")
        for i in range(self.n_envs):
            if is_fault(infos[i]):
                self._finish(i)
                continue
            episode = self.open[i]
            if episode is None:
                episode = self.open[i] = Episode(self._row(obs, i), action[i].size, skill[i], len(self.tasks))
            terminal = bool(done[i]) and not infos[i].get(TRUNCATED, False)
            paid = self._paid(infos[i]) if self.tasks else ()
            episode.append(self._row(next_obs, i), action[i].reshape(-1), float(reward[i]), terminal, skill[i], paid)
            if done[i] or len(episode) >= self.max_episode_rows:
                self._finish(i)

    def _paid(self, info: dict[str, Any]) -> list[float]:
        """What each of ``tasks`` paid for a step."""
        rewards = info.get(KEY, {})
        if missing := [task for task in self.tasks if task not in rewards]:
            raise ValueError(
                f"The environment does not tell the rewards of {', '.join(missing)}: make it with domain_rewards=True; "
                f"info[{KEY!r}] has {sorted(rewards)}."
            )
        return [rewards[task] for task in self.tasks]

    def _row(self, observation: RawObservation, i: int) -> RawObservation:
        """The observation of environment ``i``, in the types that its space declares, whatever the environment gives."""
        space = self.observation_space
        if isinstance(observation, dict):
            assert isinstance(space, spaces.Dict)
            return {name: np.asarray(part[i], space[name].dtype) for name, part in observation.items()}
        return np.asarray(observation[i], space.dtype)

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
        if len(episode) < self._shortest():
            return
        self._before_change()
        if self.disk is None:
            self.hold([episode.finish()])
            self.evict()
        else:
            self._write(episode)

    def hold(self, episodes: Iterable[Episode]) -> None:
        """Take finished episodes in, not on disk.

        :param episodes: long enough to be drawn
        :raises MemoryError: if the device has no memory for them
        """
        for episode in episodes:
            self.episodes.append(DeviceEpisode.put(episode, self.device) if self.store == stores.DEVICE else episode)
            self.finished_rows += len(episode)

    def _write(self, episode: Episode) -> None:
        """To the disk, together with what has to go for it."""
        assert self.disk is not None
        leaving, rows = 0, self.finished_rows + len(episode)
        while rows > self.buffer_size and leaving < len(self.disk):
            rows -= self.disk.lengths[leaving]
            leaving += 1
        self.disk.change(episode, leaving, {"finished_count": self.finished_count, "longest": self.longest})
        self._follow_disk()

    def evict(self) -> None:
        """Let the oldest episodes go until ``buffer_size`` is kept."""
        while self.finished_rows > self.buffer_size and len(self.episodes) > 1:
            self.finished_rows -= len(self.episodes.popleft())
            self.evicted += 1

    def columns(self) -> dict[str, tuple[th.dtype, tuple[int, ...]]]:
        """What a row of an episode consists of: name → type and shape, for files."""
        space = self.observation_space
        first = {name: _zeros(part) for name, part in space.items()} if isinstance(space, spaces.Dict) else _zeros(space)
        skill = np.zeros(self.skill_size, np.float32)
        episode = Episode(first, make_actions(self.action_space).size, skill, len(self.tasks))
        return {name: (th.from_numpy(rows[:0]).dtype, rows.shape[1:]) for name, rows in episode.columns.items()}
