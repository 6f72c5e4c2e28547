"""Whatever a file object is, save writes what load reads, or says at once that it cannot."""

from __future__ import annotations

import gzip
import io

import numpy as np
import pytest
from fake_envs import CounterEnv

from sb3_dreamer_urlb import DreamerV2
from sb3_dreamer_urlb.dreamer_v2.policies import CnnPolicy
from sb3_dreamer_urlb.replay.episode import Episode


class TakesLittle(io.RawIOBase):
    """A raw stream, forward only, that takes at most 1000 bytes at a time."""

    def __init__(self):
        self.got = b""

    def writable(self):
        return True

    def write(self, data):
        self.got += bytes(data[:1000])
        return min(len(data), 1000)


class TellsNothing:
    """As some clients of remote stores: no tell, no seek, and write returns nothing."""

    def __init__(self):
        self.got = b""

    def write(self, data):
        self.got += data


def appended(path, write):
    with open(path, "ab") as file:
        write(file)
    return open(path, "rb")


def compressed(path, write):
    with gzip.open(path, "wb") as file:
        write(file)
    return gzip.open(path, "rb")


def written(path, write):
    with open(path, "wb") as file:
        write(file)
    return open(path, "rb")


def through(kind):
    def go(_, write):
        stream = kind()
        write(stream)
        return io.BytesIO(stream.got)

    return go


def in_memory(_, write):
    stream = io.BytesIO()
    write(stream)
    return stream


STREAMS = {
    "written": written,
    "appended": appended,
    "compressed": compressed,
    "takes little": through(TakesLittle),
    "tells nothing": through(TellsNothing),
    "in memory, not rewound": in_memory,
}
stream = pytest.mark.parametrize("go", STREAMS.values(), ids=STREAMS)


@stream
def test_a_model(tiny_model, weights, tmp_path, go):
    model = tiny_model().learn(8)
    with go(tmp_path / "m", model.save) as file:
        assert weights(DreamerV2.load(file, device="cpu").policy) == weights(model.policy)


@stream
def test_a_policy(tiny_model, weights, tmp_path, go):
    policy = tiny_model().policy
    with go(tmp_path / "m", policy.save) as file:
        assert weights(CnnPolicy.load(file, device="cpu")) == weights(policy)


@stream
def test_a_replay(tiny_model, tmp_path, go):
    model = tiny_model(CounterEnv(6)).learn(20)
    before = [episode.observation.copy() for episode in model.replay_buffer.episodes]
    with go(tmp_path / "m", model.save_replay_buffer) as file:
        model.load_replay_buffer(file)
    assert all(map(np.array_equal, before, (episode.observation for episode in model.replay_buffer.episodes)))


@pytest.mark.parametrize("wrong", [None, 3, b"PK" + bytes(10_000), "text"])
def test_what_is_no_binary_file_is_named_shortly(tiny_model, wrong):
    model = tiny_model()
    wrong = io.StringIO() if wrong == "text" else wrong
    for call in (model.save, DreamerV2.load, model.save_replay_buffer, model.load_replay_buffer):
        with pytest.raises(TypeError, match=f"Expected a path or a binary file object.*got {type(wrong).__name__}") as caught:
            call(wrong)
        assert len(str(caught.value)) < 200


def test_nothing_is_written_of_what_cannot_be_read(tiny_model):
    model, stream = tiny_model(), io.BytesIO()
    model.domain = 3
    with pytest.raises(ValueError, match="not saved"):
        model.save(stream)
    assert stream.getvalue() == b""


def test_a_replay_that_grows_while_it_is_saved(tiny_model, monkeypatch):
    """By the thread that learns, while another one saves."""
    model = tiny_model(CounterEnv(20)).learn(30)
    buffer, original = model.replay_buffer, Episode.rows

    def rows(episode, start, stop):
        found = original(episode, start, stop)
        if episode is buffer.open[0]:
            last = {name: part[-1] for name, part in original(episode, 0, len(episode)).items()}
            episode.append(last["observation"], last["action"], 0.0, False, last["skill"])
        return found

    lengths = [len(episode) for episode in [*buffer.episodes, buffer.open[0]]]
    monkeypatch.setattr(Episode, "rows", rows)
    file = io.BytesIO()
    model.save_replay_buffer(file)
    monkeypatch.undo()
    model.load_replay_buffer(file)
    # The size of a row was asked for once before.
    assert [len(episode) for episode in model.replay_buffer.episodes] == [lengths[0], lengths[1] + 1]
