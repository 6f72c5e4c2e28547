"""The trap test: rows that know where they belong, so that a wrong one cannot hide (docs/concepts.md, "Replay")."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.save_util import load_from_pkl, save_to_pkl
from streams import ACTION, IMAGE, STORES, Streams, check_rows, decode, held, make_buffer

from sb3_dreamer_urlb.replay import SequenceReplayBuffer


def test_trap(store):
    rng = np.random.default_rng(1)
    buffer = make_buffer(**store)
    streams = Streams(buffer, lambda _: (int(rng.integers(1, 121)), rng.choice(["terminal", "truncated"])))
    for step in range(3 * 1500):  # three rows a step: nine times round
        streams.step()
        if step % 500 == 400:
            check_rows(streams.buffer.sample(20), held(streams))
        if step % 50 == 0 and buffer.can_sample():
            buffer.prefetch(20)
    expected = held(streams)
    assert len(streams.finished) > 200 and {end for *_, end in expected} == {"terminal", "truncated"}
    draws: Counter[tuple[int, int]] = Counter()
    for _ in range(100):
        batch = streams.buffer.sample(100)
        streams.buffer.prefetch(100)
        check_rows(batch, expected)
        episode, t = decode(batch)
        draws.update(zip(episode[:, 0].tolist(), t[:, 0].tolist(), strict=True))
    # An episode uniformly, then a start uniformly.
    chances = {(e, s): 1 / len(expected) / (rows - 9) for e, rows, _ in expected for s in range(rows - 9)}
    assert set(draws) <= set(chances)
    statistic = sum((draws[key] - 10_000 * p) ** 2 / (10_000 * p) for key, p in chances.items())
    freedom = len(chances) - 1
    assert abs(statistic - freedom) < 5 * math.sqrt(2 * freedom)
    by_episode = Counter(e for e, _ in draws.elements())
    fair = 10_000 / len(expected)
    statistic = sum((by_episode[e] - fair) ** 2 / fair for e, *_ in expected)
    assert abs(statistic - len(expected)) < 5 * math.sqrt(2 * len(expected))


@given(
    lengths=st.lists(st.integers(1, 30), min_size=1, max_size=12),
    n_envs=st.integers(1, 4),
    batch_length=st.integers(2, 12),
    buffer_size=st.integers(32, 100),  # longer than any episode: those that do not fit are cut, see below
    steps=st.integers(1, 120),
)
def test_whatever_the_lengths(lengths, n_envs, batch_length, buffer_size, steps):
    buffer = make_buffer(buffer_size, n_envs, batch_length)
    streams = Streams(buffer, lambda e: (lengths[e % len(lengths)], "terminal" if e % 2 else "truncated"))
    for _ in range(steps):
        streams.step()
    expected = held(streams)
    assert buffer.can_sample() == bool(expected)
    assert buffer.finished_rows == sum(rows for _, rows, _ in expected)
    assert buffer.finished_rows <= buffer_size or len(expected) == 1  # the newest stays, however long
    assert buffer.size() == buffer.finished_rows + sum(t + 1 for _, t, *_ in streams.now if t > 0)
    assert buffer.finished_count == len(streams.finished)
    assert buffer.longest == max((rows for _, rows, _ in streams.finished), default=0)
    if not expected:
        with pytest.raises(ValueError, match=f"batch_length={batch_length}"):
            buffer.sample(1)
        return
    batch = buffer.sample(60)
    check_rows(batch, expected)
    assert set(decode(batch)[0].flatten().tolist()) <= {e for e, *_ in expected}


def check_rows_in_a_row(batch, expected):
    """Each row carries what led to it; where an episode ends, the first row of the next one follows, marked."""
    rows_of = {e: rows for e, rows, _ in expected}
    order = [e for e, *_ in reversed(expected)]
    following = dict(zip(order, order[1:] + order[:1], strict=True))
    episode, t = decode(batch)
    is_first = batch.is_first.numpy()
    assert is_first[:, 0].all() and np.array_equal(is_first[:, 1:], t[:, 1:] == 0)
    for e, s in zip(episode, t, strict=True):
        for i in range(1, len(e)):
            last = s[i - 1] == rows_of[e[i - 1]] - 1
            assert (e[i], s[i]) == ((following[e[i - 1]], 0) if last else (e[i - 1], s[i - 1] + 1))
    ends = {e: (rows - 1, end) for e, rows, end in expected}
    terminal = [[ends[e] == (s, "terminal") for e, s in zip(*row, strict=True)] for row in zip(episode, t, strict=True)]
    assert np.array_equal(batch.is_terminal.numpy(), terminal)
    led = t > 0
    assert np.array_equal(batch.action.numpy(), np.where(led[..., None], np.stack([episode, t], -1), 0))
    assert np.allclose(batch.reward.numpy(), np.where(led, episode + t / 1000, 0), atol=1e-3)


def test_sampling_by_rows(store):
    """Short episodes are kept, sequences run on into the next one, and no row is rarer than another, last ones included."""
    buffer = make_buffer(300, n_envs=1, sampling="rows", **store)
    streams = Streams(buffer, lambda e: ((1, 40, 12, 3, 25)[e % 5], "terminal" if e % 3 else "truncated"))
    while len(streams.finished) < 40:
        streams.step()
    expected, rows = [], 0
    for episode in reversed(streams.finished):
        if rows + episode[1] > 300:
            break
        expected.append(episode)
        rows += episode[1]
    assert rows == buffer.finished_rows and min(length for _, length, _ in expected) < buffer.batch_length
    draws: Counter[tuple[int, int]] = Counter()
    for _ in range(50):
        batch = buffer.sample(20)
        buffer.prefetch(20)
        check_rows_in_a_row(batch, expected)
        episode, t = decode(batch)
        draws.update(zip(episode.flatten().tolist(), t.flatten().tolist(), strict=True))
    assert set(draws) == {(e, t) for e, length, _ in expected for t in range(length)}
    # 33 of each on average; the ten rows of a sequence are drawn together.
    by_last = np.mean([draws[e, length - 1] for e, length, _ in expected])
    assert abs(by_last / (10_000 / rows) - 1) < 0.25
    assert abs(np.mean([draws[e, 0] for e, *_ in expected]) / (10_000 / rows) - 1) < 0.25


def test_sampling_by_rows_needs_enough_rows_in_all():
    buffer = make_buffer(n_envs=1, sampling="rows")
    streams = Streams(buffer, lambda _: (2, "terminal"))
    for episodes in range(1, 6):
        for _ in range(2):
            streams.step()
        assert buffer.finished_rows == 3 * episodes and buffer.can_sample() == (3 * episodes >= 10)
    check_rows_in_a_row(buffer.sample(50), streams.finished[::-1])


def test_an_unknown_sampling_is_refused():
    with pytest.raises(ValueError, match=r"sampling must be one of \('episodes', 'rows'\), got 'uniform'"):
        make_buffer(sampling="uniform")


def test_types_and_shapes_of_a_batch():
    streams = Streams(make_buffer(), lambda _: (20, "truncated"))
    for _ in range(20):
        streams.step()
    batch = streams.buffer.sample(7)
    assert batch.observation.shape == (7, 10, 1, 2, 2) and str(batch.observation.dtype) == "torch.uint8"
    assert batch.action.shape == (7, 10, 2) and str(batch.action.dtype) == "torch.float32"
    for part, dtype in (("reward", "float32"), ("is_first", "bool"), ("is_terminal", "bool")):
        assert getattr(batch, part).shape == (7, 10) and str(getattr(batch, part).dtype) == f"torch.{dtype}"


def test_only_finished_episodes_are_drawn_and_closing_ends_them_as_truncated(store):
    buffer = make_buffer(n_envs=2, **store)
    streams = Streams(buffer, lambda _: (1000, "terminal"))
    for _ in range(30):
        streams.step()
    assert not buffer.can_sample() and buffer.size() == 2 * 31
    buffer.close_streams()
    assert buffer.can_sample() and buffer.size() == 2 * 31 and buffer.open == [None, None]
    check_rows(buffer.sample(50), [(0, 31, "truncated"), (1, 31, "truncated")])
    buffer.close_streams()  # nothing is open: nothing happens
    assert buffer.finished_count == 2


def test_endless_episodes_are_drawn_in_pieces(store):
    buffer = make_buffer(size=60, n_envs=1, max_episode_rows=20, **store)
    streams = Streams(buffer, lambda _: (10**6, "terminal"))
    for step in range(1, 200):
        streams.step()
        assert buffer.finished_rows <= 60 and buffer.size() <= 60 + 20
        # A piece holds 19 steps after its first observation.
        assert buffer.can_sample() == (step >= 19)
    assert [len(episode) for episode in buffer.episodes] == [20] * 3
    for episode in buffer.episodes:
        numbers = episode.observation.reshape(20, 4).astype(int)
        t = numbers[:, 2] + 256 * numbers[:, 3]
        assert (np.diff(t) == 1).all() and not episode.is_terminal.any()
        # The piece's first row begins it, as an episode's would.
        assert not episode.action[0].any() and episode.reward[0] == 0
        assert np.array_equal(episode.action[1:, 1], t[1:])


def test_endless_episodes_respect_the_buffers_size():
    buffer = make_buffer(size=60, n_envs=1)
    streams = Streams(buffer, lambda _: (10**6, "terminal"))
    for _ in range(200):
        streams.step()
    assert buffer.size() <= 2 * 60 and buffer.can_sample()


def test_memory_is_taken_as_episodes_arrive_and_given_back():
    buffer = SequenceReplayBuffer(10**9, spaces.Box(0, 255, (3, 64, 64), np.uint8), ACTION, "cpu", 1, batch_length=50)
    zeros = np.zeros((1, 3, 64, 64), np.uint8)
    for t in range(200):
        buffer.add(zeros, zeros, np.zeros((1, 2)), np.zeros(1), np.array([t == 199]), [{}])
    assert buffer.episodes[0].observation.nbytes == 201 * 3 * 64 * 64


@pytest.mark.parametrize("kwargs", [STORES["memory"], STORES["device"], STORES["memory, prefetched"]])
def test_equal_seeds_draw_equally(tmp_path, kwargs):
    batches = []
    for _ in range(2):
        streams = Streams(make_buffer(**kwargs), lambda e: (15 + e % 7, "truncated"))
        for _ in range(100):
            streams.step()
        batches.append(streams.buffer.sample(30))
    assert np.array_equal(*[batch.observation.numpy() for batch in batches])
    streams.buffer.prefetch(30)
    save_to_pkl(tmp_path / "replay.pkl", streams.buffer)
    copy = load_from_pkl(tmp_path / "replay.pkl")
    assert np.array_equal(copy.sample(30).observation, streams.buffer.sample(30).observation)


def test_n_dimensional_actions_are_stored_flat():
    space = spaces.Box(-1, 1, (2, 3), np.float32)
    buffer = SequenceReplayBuffer(100, IMAGE, space, "cpu", 1, batch_length=2, seed=0)
    action = np.arange(6, dtype=np.float32)
    buffer.add(np.zeros((1, 1, 2, 2)), np.zeros((1, 1, 2, 2)), action[None], np.ones(1), np.ones(1, bool), [{}])
    assert np.array_equal(buffer.sample(1).action[0].numpy(), [np.zeros(6), action])


@pytest.mark.parametrize(("name", "kwargs"), [("buffer_size", {"size": 9}), ("max_episode_rows", {"max_episode_rows": 9})])
def test_a_sequence_longer_than_what_is_kept_is_refused(name, kwargs):
    with pytest.raises(ValueError, match=f"batch_length=10.*{name}=9"):
        make_buffer(**kwargs)


def test_reset_forgets_everything(store):
    streams = Streams(make_buffer(**store), lambda _: (20, "truncated"))
    for _ in range(25):
        streams.step()
    streams.buffer.reset()
    assert streams.buffer.size() == 0 and not streams.buffer.can_sample() and streams.buffer.finished_count == 0
