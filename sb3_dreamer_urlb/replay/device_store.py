"""Finished episodes in the memory of the learner's device: batches are gathered there, and never cross the bus.

Each episode goes there once, when it ends, and takes the memory of its rows; one that is driven out gives it back.
"""

from __future__ import annotations

import numpy as np
import torch as th

from sb3_dreamer_urlb.replay.episode import Episode
from sb3_dreamer_urlb.replay.rows import NamedRows


class DeviceEpisode(NamedRows):
    """A finished episode on a device.

    :param columns: rows of each of ``SequenceReplayBuffer.columns``, (rows, …)
    """

    def __init__(self, columns: dict[str, th.Tensor]):
        self.columns = columns

    @classmethod
    def put(cls, episode: Episode, device: th.device) -> DeviceEpisode:
        """Copy an episode.

        :param episode: finished, in memory
        :param device: where to
        :raises MemoryError: if there is no memory left
        """
        rows = {name: th.from_numpy(part) for name, part in episode.rows(0, len(episode)).items()}
        try:
            if device.type == "cuda":
                # From pinned memory, so that nothing waits for the update that the device may be at.
                return cls({name: part.pin_memory().to(device, non_blocking=True) for name, part in rows.items()})
            return cls({name: part.to(device, copy=True) for name, part in rows.items()})
        except th.OutOfMemoryError:
            size = sum(part.nbytes for part in rows.values())
            raise MemoryError(
                f"The device {device} has no memory left for an episode of {len(episode)} rows, {size / 1e6:.1f} MB. Choose a "
                "smaller buffer_size, or replay_buffer_kwargs={'store': 'memory'}."
            ) from None

    def __len__(self) -> int:
        return len(self.columns["reward"])

    def part(self, start: int, stop: int) -> dict[str, th.Tensor]:
        """Some rows of every column, by name; no copies."""
        return {name: column[start:stop] for name, column in self.columns.items()}

    def rows(self, start: int, stop: int) -> dict[str, np.ndarray]:
        """The same on the host, copied unless it is the device."""
        return {name: part.cpu().numpy() for name, part in self.part(start, stop).items()}


class OnItsWay:
    """An open episode as batches on a device see it: what is asked for is copied there.

    :param episode: in memory
    :param device: where to
    """

    def __init__(self, episode: Episode, device: th.device):
        self.episode, self.device = episode, device

    def __len__(self) -> int:
        return len(self.episode)

    def part(self, start: int, stop: int) -> dict[str, th.Tensor]:
        """Some rows of every column, by name."""
        return {name: th.from_numpy(part).to(self.device) for name, part in self.episode.rows(start, stop).items()}

    def rows(self, start: int, stop: int) -> dict[str, np.ndarray]:
        """The same on the host; no copies."""
        return self.episode.rows(start, stop)
