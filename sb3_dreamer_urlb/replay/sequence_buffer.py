"""Replay of whole episodes, drawn as sequences (spec/algorithms §3, spec/reliability "Replay").

Row t of an episode holds observation t with the action and the reward that *led to* it. Each environment writes its own
stream, so episodes may end at different times; only finished episodes are drawn. A sequence never leaves its episode, unless
``sampling="rows"`` says so.
"""

from __future__ import annotations

import math
import os
import warnings
from collections import deque
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import BaseBuffer, ReplayBuffer
from stable_baselines3.common.vec_env import VecNormalize

from sb3_dreamer_urlb.actions import make_actions
from sb3_dreamer_urlb.env_steps import is_fault
from sb3_dreamer_urlb.replay import stores
from sb3_dreamer_urlb.replay.sampling import BY_EPISODE, check_sampling, draw
from sb3_dreamer_urlb.types import SequenceBatch

if TYPE_CHECKING:
    from sb3_dreamer_urlb.replay.lmdb_store import LmdbStore

RawObservation = np.ndarray | dict[str, np.ndarray]
#: column of an observation, or of the part of a Dict observation whose name follows
OBSERVATION = "observation"


class Episode:
    """Contiguous rows that grow while the episode is open.

    :param observation: the episode's first observation; a Dict observation takes one column for each part
    :param action_size: A
    :param skill: under which the first action is chosen, (W,)
    """

    def __init__(self, observation: RawObservation, action_size: int, skill: np.ndarray):
        capacity = 128
        seen = observation_columns(observation)
        #: rows of each column, the first ``length`` of them filled
        self.columns: dict[str, np.ndarray] = {
            **{name: np.empty((capacity, *value.shape), value.dtype) for name, value in seen.items()},
            "action": np.zeros((capacity, action_size), np.float32),
            "reward": np.zeros(capacity, np.float32),
            "is_terminal": np.zeros(capacity, bool),
            "skill": np.zeros((capacity, len(skill)), np.float32),
        }
        self.length = 0
        self._put({**seen, "skill": skill})

    @classmethod
    def of(cls, columns: dict[str, np.ndarray]) -> Episode:
        """A finished episode of given rows, for example from a file.

        :param columns: rows of each of ``SequenceReplayBuffer.columns``
        """
        episode = cls.__new__(cls)
        episode.columns, episode.length = columns, len(columns["reward"])
        return episode

    def __len__(self) -> int:
        return self.length

    @property
    def observation(self) -> RawObservation:
        """All rows of it, by name for Dict observations."""
        return observation_of(self.columns)

    @property
    def action(self) -> np.ndarray:
        """All rows of it."""
        return self.columns["action"]

    @property
    def reward(self) -> np.ndarray:
        """All rows of it."""
        return self.columns["reward"]

    @property
    def is_terminal(self) -> np.ndarray:
        """All rows of it."""
        return self.columns["is_terminal"]

    @property
    def skill(self) -> np.ndarray:
        """All rows of it."""
        return self.columns["skill"]

    def append(
        self, observation: RawObservation, action: np.ndarray, reward: float, is_terminal: bool, skill: np.ndarray
    ) -> None:
        """Add the row that ``action``, chosen under ``skill``, led to."""
        if self.length == len(self.reward):
            self._resize(2 * self.length)
        seen = observation_columns(observation)
        self._put({**seen, "action": action, "reward": reward, "is_terminal": is_terminal, "skill": skill})

    def rows(self, start: int, stop: int) -> dict[str, np.ndarray]:
        """Some rows of every column, by name; no copies."""
        return {name: part[start:stop] for name, part in self.columns.items()}

    def finish(self) -> Episode:
        """Give unused memory back."""
        self._resize(self.length)
        return self

    def _put(self, row: dict[str, Any]) -> None:
        for name, value in row.items():
            self.columns[name][self.length] = value
        self.length += 1

    def _resize(self, capacity: int) -> None:
        for name, old in self.columns.items():
            new = np.empty((capacity, *old.shape[1:]), old.dtype)
            new[: self.length] = old[: self.length]
            self.columns[name] = new


def observation_columns(observation: RawObservation) -> dict[str, np.ndarray]:
    """The columns that an observation fills: one, or one for each part of a Dict observation."""
    if isinstance(observation, dict):
        return {f"{OBSERVATION}/{name}": np.asarray(part) for name, part in observation.items()}
    return {OBSERVATION: np.asarray(observation)}


def observation_of(columns: dict[str, np.ndarray]) -> RawObservation:
    """The observation among columns; undoes :func:`observation_columns`."""
    if OBSERVATION in columns:
        return columns[OBSERVATION]
    prefix = f"{OBSERVATION}/"
    return {name.removeprefix(prefix): rows for name, rows in columns.items() if name.startswith(prefix)}


def _zeros(space: spaces.Space[Any]) -> np.ndarray:
    assert space.shape is not None
    return np.zeros(space.shape, space.dtype)


class SequenceReplayBuffer(ReplayBuffer):
    """Replay of episodes, one stream per environment; finished ones in memory or on disk.

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
    :param store: ``"memory"``, or ``"lmdb"`` for a file that survives the process (``pip install
        'sb3_dreamer_urlb[lmdb]'``); open episodes are in memory in any case
    :param path: folder of the file; each phase has its own in it. Rows that an earlier run left there are taken over
    :param map_size: bytes that the file may have; None for what ``buffer_size`` rows need
    :param sampling: ``"episodes"`` draws an episode uniformly, then a start uniformly, and leaves out episodes shorter than
        a sequence (the paper); ``"rows"`` draws the start from all rows uniformly, and goes on with the next episode's first
        row where one ends before the sequence does. For tasks that terminate: short episodes are kept and weigh no more
        than they are long, and last rows, which show how episodes end, come as often as any other
    :raises ValueError: for arguments that do not fit
    :raises ModuleNotFoundError: if lmdb is not installed
    """

    def __init__(
        self,
        buffer_size: int,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        device: th.device | str = "auto",
        n_envs: int = 1,
        *,
        batch_length: int,
        max_episode_rows: int = 5000,
        seed: int | None = None,
        phase: str = "",
        skill_size: int = 0,
        store: str = "memory",
        path: str | os.PathLike[str] | None = None,
        map_size: int | None = None,
        sampling: str = BY_EPISODE,
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
        check_sampling(sampling)
        self.sampling = sampling
        self.phase = phase
        self.skill_size = skill_size
        self.rng = np.random.default_rng(seed)
        stores.check_store(store, path, map_size)
        self.disk: LmdbStore | None = None
        self.path = None if path is None else Path(path) / (phase or "replay")
        self.map_size = map_size
        stores.warn_if_too_large(buffer_size, self.row_bytes(), self.path)
        self._reset_memory()

    def row_bytes(self) -> int:
        """Bytes of one row."""
        return sum(dtype.itemsize * math.prod(shape) for dtype, shape in self.columns().values())

    def reset(self) -> None:
        """Forget everything, also on disk."""
        self._reset_memory()
        if self.path is not None:
            self.attach(taking_over=True)
            self.roll_back(0, {"evicted": 0, "finished_count": 0, "longest": 0})

    def _reset_memory(self) -> None:
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
        numbers = {name: counters[name] for name in ("finished_count", "longest")}
        lost = self.disk.roll_back(end, counters["evicted"], numbers)
        if lost:
            warnings.warn(
                f"{self.path}: {lost} episodes that the checkpoint drew from were driven out after it, for map_size="
                f"{self.disk.map_size} bytes had no room for them. The run goes on, but not bit for bit."
            )
        self._follow_disk()

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
                episode = self.open[i] = Episode(self._row(obs, i), action[i].size, skill[i])
            terminal = bool(done[i]) and not infos[i].get("TimeLimit.truncated", False)
            episode.append(self._row(next_obs, i), action[i].reshape(-1), float(reward[i]), terminal, skill[i])
            if done[i] or len(episode) >= self.max_episode_rows:
                self._finish(i)

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
        if self.sampling == BY_EPISODE and len(episode) < self.batch_length:
            return
        if self.disk is None:
            self.episodes.append(episode.finish())
            self.finished_rows += len(episode)
            self.evict()
        else:
            self._write(episode)

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
        episode = Episode(first, make_actions(self.action_space).size, np.zeros(self.skill_size, np.float32))
        return {name: (th.from_numpy(rows[:0]).dtype, rows.shape[1:]) for name, rows in episode.columns.items()}

    # -- reading -------------------------------------------------------------------------------------------------------

    def can_sample(self) -> bool:
        """Whether any finished episode is long enough, or all of them together if sequences may run through several."""
        self.attach()
        return len(self.episodes) > 0 and self.finished_rows >= self.batch_length

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> SequenceBatch:  # type: ignore[override]
        """Draw sequences, as ``sampling`` says.

        :param batch_size: B
        :param env: normalises observations and rewards if given
        :return: (B, T, …) on ``device``
        :raises ValueError: if finished episodes have not the rows for it
        """
        if not self.can_sample():
            raise ValueError(f"No finished episode has batch_length={self.batch_length} rows yet.")
        length = self.batch_length
        columns = {
            name: np.empty((batch_size, length, *rows.shape[1:]), rows.dtype)
            for name, rows in self.episodes[0].rows(0, 1).items()
        }
        is_first = np.zeros((batch_size, length), bool)
        for b, pieces in enumerate(draw(self.sampling, self.rng, self.episodes, length, batch_size)):
            t = 0
            for index, start, stop in pieces:
                is_first[b, t] = True
                for name, rows in self.episodes[index].rows(start, stop).items():
                    columns[name][b, t : t + stop - start] = rows
                t += stop - start
        observation = self._normalize_obs(observation_of(columns), env)
        reward = self._normalize_reward(columns["reward"], env).astype(np.float32, copy=False)
        return SequenceBatch(
            {name: self._tensor(part) for name, part in observation.items()}
            if isinstance(observation, dict)
            else self._tensor(observation),
            self._tensor(columns["action"]),
            self._tensor(reward),
            self._tensor(is_first),
            self._tensor(columns["is_terminal"]),
            self._tensor(columns["skill"]) if self.skill_size else None,
        )

    def _tensor(self, array: np.ndarray) -> th.Tensor:
        return th.from_numpy(array).to(self.device, non_blocking=True)
