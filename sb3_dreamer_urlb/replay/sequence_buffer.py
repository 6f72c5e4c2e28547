"""Replay of whole episodes, drawn as sequences (docs/algorithm.md, "Replay"; docs/concepts.md, "Replay").

Only finished episodes are drawn. A sequence never leaves its episode, unless ``sampling="rows"`` says so.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecNormalize

from sb3_dreamer_urlb.number_checks import check_integer
from sb3_dreamer_urlb.replay import gathering, stores
from sb3_dreamer_urlb.replay.episode_buffer import MAX_EPISODE_ROWS, EpisodeBuffer
from sb3_dreamer_urlb.replay.prefetch import Prefetcher
from sb3_dreamer_urlb.replay.rows import TASK_REWARDS, observation_columns, observation_of
from sb3_dreamer_urlb.replay.sampling import BY_EPISODE, Pieces, check_sampling, draw
from sb3_dreamer_urlb.types import SequenceBatch


class SequenceReplayBuffer(EpisodeBuffer):
    """Replay of episodes, one stream per environment; finished ones in memory, on the learner's device or on disk.

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
    :param tasks: names of tasks whose rewards are stored with each row, from ``info["domain_rewards"]``
    :param store: ``"memory"``; ``"device"`` for the memory of ``device``, so that batches need not go there; ``"auto"`` for
        the latter on CUDA if ``buffer_size`` rows fit, else the former; or ``"lmdb"`` for a file that survives the process
        (``pip install '.[lmdb]'``). Open episodes are in memory in any case
    :param path: folder of the file; each phase has its own in it. Rows that an earlier run left there are taken over
    :param map_size: bytes that the file may have; None for what ``buffer_size`` rows need
    :param prefetch: let a thread gather the next batch and bring it to the device while something else goes on
        (:meth:`prefetch`); None does so on CUDA. Not for ``store="device"``, which has nothing to bring
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
        max_episode_rows: int = MAX_EPISODE_ROWS,
        seed: int | None = None,
        phase: str = "",
        skill_size: int = 0,
        tasks: Sequence[str] = (),
        store: str = stores.AUTO,
        path: str | os.PathLike[str] | None = None,
        map_size: int | None = None,
        prefetch: bool | None = None,
        sampling: str = BY_EPISODE,
    ):
        if seed is not None:
            check_integer("seed", seed, 0)
        check_sampling(sampling)
        super().__init__(
            buffer_size,
            observation_space,
            action_space,
            device,
            n_envs,
            max_episode_rows=max_episode_rows,
            phase=phase,
            skill_size=skill_size,
            tasks=tasks,
            store=store,
            path=path,
            map_size=map_size,
        )
        if batch_length > self.max_episode_rows:
            raise ValueError(
                f"batch_length={batch_length} must not exceed buffer_size={buffer_size} "
                f"and max_episode_rows={max_episode_rows}."
            )
        self.batch_length = batch_length
        self.sampling = sampling
        self.rng = np.random.default_rng(seed)
        on_device = self.store == stores.DEVICE
        if prefetch is not None and not isinstance(prefetch, bool):
            raise ValueError(f"prefetch must be True, False or None, got {prefetch!r}.")
        if prefetch and on_device:
            raise ValueError(f"prefetch={prefetch!r} and store='device': rows that are on the device need no fetching.")
        self.prefetches = self.device.type == "cuda" and not on_device if prefetch is None else prefetch
        self._prefetcher: Prefetcher[tuple[gathering.Tensors, Mapping[str, Any]]] = Prefetcher()
        self._transfer = gathering.make_transfer(self.device if self.prefetches else None)

    def check_lengths(self, batch_length: int) -> None:
        """Whether the episodes of another buffer can be drawn from this one.

        :param batch_length: of the other
        :raises ValueError: if they may be too short, or those that are missing long enough
        """
        if batch_length != self.batch_length:
            raise ValueError(f"the replay buffer has batch_length={batch_length}, the model {self.batch_length}")

    def _shortest(self) -> int:
        return self.batch_length if self.sampling == BY_EPISODE else 1

    def _before_change(self) -> None:
        self._prefetcher.discard()

    # -- reading -------------------------------------------------------------------------------------------------------

    def can_sample(self) -> bool:
        """Whether any finished episode is long enough, or all of them together if sequences may run through several."""
        self.attach()
        return len(self.episodes) > 0 and self.finished_rows >= self.batch_length

    @property
    def waits_for(self) -> str:
        """What there has to be before :meth:`can_sample`, for people."""
        return f"episodes to end that have batch_length={self.batch_length} steps"

    def sample(self, batch_size: int, env: VecNormalize | None = None) -> SequenceBatch:  # type: ignore[override]
        """Draw sequences, as ``sampling`` says.

        :param batch_size: B
        :param env: normalises observations and rewards if given
        :return: (B, T, …) on ``device``
        :raises ValueError: if finished episodes have not the rows for it
        """
        if not self.can_sample():
            raise ValueError(f"No finished episode has batch_length={self.batch_length} rows yet.")
        columns = self._drawn(batch_size) if env is None else self._drawn_and_normalized(batch_size, env)
        return SequenceBatch(
            observation_of(columns),
            columns["action"],
            columns["reward"],
            columns[gathering.IS_FIRST],
            columns["is_terminal"],
            columns["skill"] if self.skill_size else None,
            columns.get(TASK_REWARDS),
        )

    def _drawn(self, batch_size: int) -> gathering.Tensors:
        """A batch as it is stored, on ``device``."""
        found = self._prefetcher.take(self._moment(batch_size))
        if found is not None:
            columns, self.rng.bit_generator.state = found
            return self._transfer.ready(columns)
        draws = self._draws(self.rng, batch_size)
        if self.store == stores.DEVICE:
            return gathering.on_device(draws, self.batch_length)
        if self.prefetches:
            return self._transfer.ready(self._transfer.bring(draws, self.batch_length))
        return {name: self._tensor(rows) for name, rows in gathering.on_host(draws, self.batch_length).items()}

    def _drawn_and_normalized(self, batch_size: int, env: VecNormalize) -> gathering.Tensors:
        """A batch normalised with the present statistics, which are numpy's, on the host."""
        columns = gathering.on_host(self._draws(self.rng, batch_size), self.batch_length)
        observation: Any = self._normalize_obs(observation_of(columns), env)
        reward = self._normalize_reward(columns["reward"], env).astype(np.float32, copy=False)
        columns = {**columns, **observation_columns(observation), "reward": reward}
        return {name: self._tensor(rows) for name, rows in columns.items()}

    def _draws(self, rng: np.random.Generator, batch_size: int) -> list[gathering.Draw]:
        """Which rows make the sequences."""
        places = self._pieces(rng, batch_size)
        episodes = self._drawn_from()
        return [[(episodes[index], start, stop) for index, start, stop in pieces] for pieces in places]

    def _pieces(self, rng: np.random.Generator, batch_size: int) -> Iterator[Pieces]:
        """Where they lie."""
        return draw(self.sampling, rng, self._drawn_from(), self.batch_length, batch_size)

    def _drawn_from(self) -> Any:
        """The episodes that may be drawn, oldest first."""
        return self.episodes

    def _tensor(self, array: np.ndarray) -> th.Tensor:
        return th.from_numpy(array).to(self.device, non_blocking=True)

    # -- ahead of time -------------------------------------------------------------------------------------------------

    def prefetch(self, batch_size: int, env: VecNormalize | None = None) -> None:
        """Begin to gather what :meth:`sample` will give next, in a thread; nothing happens unless ``prefetches``.

        It is drawn with a copy of the sampler, and taken only if sampler, episodes and size are the same then: otherwise
        it is dropped, and drawn again as if nothing had been. So batches do not depend on it.

        :param batch_size: B
        :param env: whose statistics the batch will be normalised with: they may change until then, so nothing is begun
        """
        if not self.prefetches or env is not None or not self.can_sample():
            return
        rng = copy.deepcopy(self.rng)
        draws = self._draws(rng, batch_size)
        transfer, length, after = self._transfer, self.batch_length, rng.bit_generator.state
        self._prefetcher.begin(self._moment(batch_size), lambda: (transfer.bring(draws, length), after))

    def _moment(self, batch_size: int) -> tuple[Any, ...]:
        """All that a batch depends on: what changes none of it leaves the batch the same."""
        held = (id(self.episodes), self.evicted, len(self.episodes), self.finished_rows)
        return batch_size, *held, self.rng.bit_generator.state

    def close(self) -> None:
        """End the thread, and give the device's memory back: rows that are there are forgotten, others stay."""
        self._prefetcher.close()
        if self.store == stores.DEVICE:
            self._forget()
