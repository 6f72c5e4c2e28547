"""Streams of rows that tell where they come from, and replay buffers to hold them."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces

from sb3_dreamer_urlb.replay import SequenceReplayBuffer

IMAGE = spaces.Box(0, 255, (1, 2, 2), np.uint8)
ACTION = spaces.Box(-1, 1, (2,), np.float32)


def picture(episode: int, t: int) -> np.ndarray:
    """An image that tells its episode and its step."""
    return np.array([episode % 256, episode // 256, t % 256, t // 256], np.uint8).reshape(1, 2, 2)


class Streams:
    """Feeds a buffer as SB3 does: lock-step, with the true last observation where an episode ends.

    Rows of episode e: observation (e, t), action (e, t), reward e + t / 1000.

    :param buffer: to feed
    :param lengths: function giving the steps and the end ("terminal" or "truncated") of an episode
    """

    def __init__(self, buffer, lengths):
        self.buffer, self.lengths = buffer, lengths
        self.started = 0
        #: (episode, rows, end) of finished episodes, in the order in which they ended
        self.finished: list[tuple[int, int, str]] = []
        self.now = [self._begin() for _ in range(buffer.n_envs)]

    def _begin(self):
        self.started += 1
        return [self.started - 1, 0, *self.lengths(self.started - 1)]

    def step(self):
        n = len(self.now)
        obs = np.stack([picture(e, t) for e, t, *_ in self.now])
        for episode in self.now:
            episode[1] += 1
        next_obs = np.stack([picture(e, t) for e, t, *_ in self.now])
        action = np.array([[e, t] for e, t, *_ in self.now], np.float32)
        reward = np.array([e + t / 1000 for e, t, *_ in self.now], np.float32)
        done = np.array([t == length for _, t, length, _ in self.now])
        infos = [{"TimeLimit.truncated": bool(d) and end == "truncated"} for d, (*_, end) in zip(done, self.now, strict=True)]
        self.buffer.add(obs, next_obs, action, reward, done, infos)
        for i in range(n):
            if done[i]:
                episode, t, _, end = self.now[i]
                self.finished.append((episode, t + 1, end))
                self.now[i] = self._begin()


def make_buffer(size=1500, n_envs=3, batch_length=10, image=IMAGE, **kwargs):
    return SequenceReplayBuffer(size, image, ACTION, "cpu", n_envs, batch_length=batch_length, seed=0, **kwargs)


def decode(batch):
    """(episode, t), both (B, T)."""
    pixels = batch.observation.numpy().reshape(*batch.observation.shape[:2], 4).astype(int)
    return pixels[..., 0] + 256 * pixels[..., 1], pixels[..., 2] + 256 * pixels[..., 3]


def held(streams):
    """The finished episodes that must still be there: the newest that fit, too short ones apart."""
    kept, rows = [], 0
    for episode, length, end in reversed([e for e in streams.finished if e[1] >= streams.buffer.batch_length]):
        if kept and rows + length > streams.buffer.buffer_size:
            break
        kept.append((episode, length, end))
        rows += length
    return kept


def check_rows(batch, ends=None):
    """Every row carries what led to it, and no sequence leaves its episode."""
    episode, t = decode(batch)
    assert (episode == episode[:, :1]).all() and (np.diff(t, axis=1) == 1).all()
    led = t > 0
    expected_action = np.where(led[..., None], np.stack([episode, t], -1), 0)
    assert np.array_equal(batch.action.numpy(), expected_action)
    assert np.allclose(batch.reward.numpy(), np.where(led, episode + t / 1000, 0), atol=1e-3)
    assert batch.is_first[:, 0].all() and not batch.is_first[:, 1:].any()
    if ends is not None:
        last = {e: (rows - 1, end) for e, rows, end in ends}
        terminal = [
            [last[e] == (step, "terminal") for e, step in zip(*row, strict=True)] for row in zip(episode, t, strict=True)
        ]
        assert np.array_equal(batch.is_terminal.numpy(), terminal)


#: everything that keeps or brings rows, as arguments
STORES = {
    "memory": {},
    "lmdb": {"store": "lmdb", "path": "replay"},
    "device": {"store": "device"},
    "memory, prefetched": {"prefetch": True},
    "lmdb, prefetched": {"store": "lmdb", "path": "replay", "prefetch": True},
}
