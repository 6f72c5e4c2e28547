"""Replay on the device and batches ahead of time: the same rows, draws and runs as in memory, bit for bit."""

from __future__ import annotations

import contextlib
import copy
import gc
import os
import pickle
import threading
import time
import warnings
import weakref

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from streams import ACTION, IMAGE, STORES, Streams, check_rows, held, make_buffer
from whole_runs import everything, scramble, vec_env

from sb3_dreamer_urlb import DreamerV2, PhaseSwitchCallback, RunCheckpointCallback
from sb3_dreamer_urlb.replay import SequenceReplayBuffer, device_store, gathering, stores
from sb3_dreamer_urlb.replay.device_store import DeviceEpisode
from sb3_dreamer_urlb.replay.lmdb_store import ReplayStoreError
from sb3_dreamer_urlb.replay.prefetch import Prefetcher

DICT = spaces.Dict({"image": IMAGE, "more/numbers": spaces.Box(-1, 1, (3,), np.float64)})
LENGTHS = (30, 61, 9, 10, 25, 50)


class DictStreams(Streams):
    """The same, where the observation has a second part and each row a skill."""

    def __init__(self, buffer, lengths):
        super().__init__(buffer, lengths)
        add, generator = buffer.add, np.random.default_rng(0)

        def add_more(obs, next_obs, *rest):
            numbers = generator.uniform(-1, 1, (2, len(obs), 3))
            parts = [{"image": part, "more/numbers": more} for part, more in zip((obs, next_obs), numbers, strict=True)]
            add(*parts, *rest, skill=generator.uniform(size=(len(obs), 4)).astype(np.float32))

        buffer.add = add_more


def filled(buffer, steps=800):
    kind = DictStreams if isinstance(buffer.observation_space, spaces.Dict) else Streams
    streams = kind(buffer, lambda e: (LENGTHS[e % len(LENGTHS)], "terminal" if e % 2 else "truncated"))
    for _ in range(steps):
        streams.step()
    return streams


def parts(batch):
    """Everything in a batch, by name: dtype, shape, bytes."""
    seen = batch.observation if isinstance(batch.observation, dict) else {"": batch.observation}
    found = {f"observation {name}": part for name, part in seen.items()}
    found |= {name: getattr(batch, name) for name in ("action", "reward", "is_first", "is_terminal", "skill")}
    return {n: None if p is None else (p.dtype, p.shape, p.cpu().numpy().tobytes()) for n, p in found.items()}


@pytest.mark.parametrize("kwargs", [{}, {"image": DICT, "skill_size": 4}, {"sampling": "rows", "size": 600}])
def test_all_stores_hold_and_draw_the_same(store, kwargs):
    expected, mine = filled(make_buffer(**kwargs)), filled(make_buffer(**kwargs, **store))
    for round_, size in enumerate((40, 40, 40, 7, 40, 40)):
        assert parts(mine.buffer.sample(size)) == parts(expected.buffer.sample(size))
        mine.buffer.prefetch(40)
        for streams in (expected, mine) if round_ % 2 else ():
            for _ in range(20):
                streams.step()
    assert mine.buffer.evicted == expected.buffer.evicted > 0
    assert mine.buffer.size() == expected.buffer.size() and mine.buffer.longest == expected.buffer.longest
    for episode, its in zip(mine.buffer.episodes, expected.buffer.episodes, strict=True):
        rows, theirs = episode.rows(3, 9), its.rows(3, 9)
        assert rows.keys() == theirs.keys() and all(np.array_equal(rows[name], theirs[name]) for name in rows)


# -- on the device ---------------------------------------------------------------------------------------------------------


def test_an_episode_looks_as_in_memory():
    (mine, its) = (filled(make_buffer(**kwargs), 100).buffer.episodes[0] for kwargs in (STORES["device"], {}))
    assert isinstance(mine, DeviceEpisode) and len(mine) == len(its)
    for name in ("observation", "action", "reward", "is_terminal", "skill"):
        assert np.array_equal(getattr(mine, name), getattr(its, name))
    with pytest.raises(AttributeError, match="colour"):
        mine.colour  # noqa: B018
    assert list(copy.deepcopy(mine).columns) == list(mine.columns)


def test_rows_that_are_driven_out_give_their_memory_back():
    streams = filled(make_buffer(**STORES["device"]), 100)
    rows = weakref.ref(streams.buffer.episodes[0].columns["observation"])
    for _ in range(800):
        streams.step()
    assert streams.buffer.evicted > 0 and rows() is None


def test_a_row_on_the_device_is_a_copy():
    buffer = make_buffer(n_envs=1, **STORES["device"])
    streams = Streams(buffer, lambda _: (20, "truncated"))
    for _ in range(19):
        streams.step()
    open_ = buffer.open[0]
    streams.step()
    open_.columns["observation"][:] = 77
    check_rows(buffer.sample(10), held(streams))


def test_a_device_that_is_full(monkeypatch):
    class Full:
        nbytes = 5_000_000

        def to(self, *_, **__):
            raise th.OutOfMemoryError("CUDA out of memory. Tried to allocate")

    episode = filled(make_buffer(), 100).buffer.episodes[0]
    monkeypatch.setattr(device_store.th, "from_numpy", lambda _: Full())
    with pytest.raises(MemoryError, match=r"cpu has no memory left for an episode of \d+ rows, 25.0 MB. Choose a smaller"):
        DeviceEpisode.put(episode, th.device("cpu"))


def test_what_auto_stands_for(monkeypatch):
    monkeypatch.setattr(stores, "free_memory", lambda device: 10**10 if device.type == "cuda" else 10**15)
    cuda, cpu = th.device("cuda"), th.device("cpu")
    assert stores.choose("auto", cuda, 6 * 10**9) == "device"
    assert stores.choose("auto", cuda, 6 * 10**9 + 1) == "memory"  # the rest is for updates
    assert stores.choose("auto", cpu, 1) == "memory"
    assert [stores.choose(name, cuda, 10**11) for name in ("memory", "device", "lmdb")] == ["memory", "device", "lmdb"]
    assert make_buffer().store == "memory" and not make_buffer().prefetches


def test_a_buffer_beyond_the_device_warns(monkeypatch):
    monkeypatch.setattr(stores, "free_memory", lambda _: 10**9)
    row = 4 + 2 * 4 + 4 + 1
    message = (
        rf"buffer_size=100000000 rows of {row} bytes will take 1.7 GB, but there are 1.0 GB of free memory on the device cpu"
    )
    with pytest.warns(UserWarning, match=message):
        make_buffer(10**8, **STORES["device"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make_buffer(10**7, **STORES["device"])


def test_a_closed_buffer_gives_the_device_back():
    buffer = filled(make_buffer(**STORES["device"])).buffer
    rows = weakref.ref(buffer.episodes[0].columns["observation"])
    buffer.close()
    assert rows() is None and not buffer.can_sample() and buffer.size() == 0
    memory = filled(make_buffer()).buffer
    memory.close()
    assert memory.can_sample()


# -- ahead of time ---------------------------------------------------------------------------------------------------------


class Watched(gathering.Transfer):
    """Knows in which thread each batch was gathered."""

    def __init__(self):
        self.threads = []

    def bring(self, draws, length):
        self.threads.append(threading.current_thread().name)
        return super().bring(draws, length)


@pytest.fixture
def ahead():
    buffer = filled(make_buffer(prefetch=True)).buffer
    buffer._transfer = Watched()
    yield buffer
    buffer.close()


def in_thread(buffer):
    found = [name.startswith("prefetch") for name in buffer._transfer.threads]
    buffer._transfer.threads.clear()
    return found


def test_a_batch_is_gathered_in_the_thread_and_taken(ahead):
    state = ahead.rng.bit_generator.state
    ahead.prefetch(8)
    assert ahead.rng.bit_generator.state == state  # what a checkpoint holds
    ahead.sample(8)
    assert in_thread(ahead) == [True] and ahead.rng.bit_generator.state != state
    ahead.sample(8)
    assert in_thread(ahead) == [False]


@pytest.mark.parametrize(
    "change",
    [
        lambda buffer: buffer.close_streams(),  # an episode more
        lambda buffer: buffer.episodes.popleft(),
        lambda buffer: buffer.rng.integers(5),
        lambda buffer: buffer.sample(3),
        lambda buffer: buffer.hold([buffer.episodes[0]]),
    ],
)
def test_a_batch_of_another_moment_is_dropped(ahead, change):
    ahead.prefetch(8)
    change(ahead)
    in_thread(ahead)
    ahead.sample(8)
    assert in_thread(ahead) == [False]


def test_nothing_is_begun_in_vain(ahead):
    make_buffer(prefetch=True).prefetch(8)  # no rows yet
    ahead.prefetch(8, env=object())  # statistics change
    off = filled(make_buffer()).buffer
    off.prefetch(8)
    assert in_thread(ahead) == [] and off._prefetcher._executor is None


def test_what_the_thread_raises_comes_to_whoever_samples(tmp_path):
    buffer = filled(make_buffer(store="lmdb", path=tmp_path, prefetch=True)).buffer
    with buffer.disk.env.begin(write=True) as transaction:
        for episode in buffer.episodes:
            buffer.disk._delete(transaction, episode.number, len(episode))
    buffer.prefetch(8)
    with pytest.raises(ReplayStoreError, match="are missing"):
        buffer.sample(8)
    buffer.prefetch(8)
    buffer.roll_back(0, {"evicted": 0, "finished_count": 0, "longest": 0})  # nobody wants it any more
    assert not buffer.can_sample()


def test_a_checkpoint_does_not_move_the_file_under_the_thread(tmp_path, monkeypatch):
    """LMDB maps the file anew to remove what left: whoever reads meanwhile would read memory that is gone."""
    buffer = filled(make_buffer(store="lmdb", path=tmp_path, prefetch=True)).buffer
    reading, read, at_rest = threading.Event(), buffer.disk.read, []

    def slow(*args):
        reading.set()
        time.sleep(0.02)
        return read(*args)

    monkeypatch.setattr(buffer.disk, "read", slow)
    monkeypatch.setattr(buffer.disk, "release", lambda first: at_rest.append((first, buffer._prefetcher._pending)))
    buffer.prefetch(8)
    assert reading.wait(10) and buffer._prefetcher._pending is not None
    buffer.release()
    assert at_rest == [(buffer.evicted, None)]
    buffer.close()


def prefetching():
    return [thread for thread in threading.enumerate() if thread.name.startswith("prefetch")]


@pytest.mark.parametrize("end", ["close", "del"])
def test_no_thread_is_left(end):
    before = prefetching()  # of other tests, which the garbage collector has not come to yet
    buffer = filled(make_buffer(prefetch=True)).buffer
    buffer.prefetch(8)
    (thread,) = set(prefetching()) - set(before)
    if end == "close":
        buffer.close()
        buffer.close()
    del buffer
    gc.collect()
    thread.join(10)
    assert not thread.is_alive()


def test_copies_begin_with_nothing(ahead):
    expected = parts(copy.deepcopy(ahead).sample(8))
    ahead.prefetch(8)
    for copied in (copy.deepcopy(ahead._prefetcher), pickle.loads(pickle.dumps(ahead._prefetcher))):
        assert copied._pending is None and copied._executor is None
    assert parts(copy.deepcopy(ahead).sample(8)) == expected == parts(ahead.sample(8))


def test_a_forked_child_does_not_wait_for_the_parents_thread(ahead):
    expected = parts(copy.deepcopy(ahead).sample(8))
    ahead.prefetch(8)
    child = os.fork()
    if child == 0:
        with contextlib.suppress(BaseException):
            right = parts(ahead.sample(8)) == expected
            ahead.prefetch(8)
            ahead.sample(8)
            os._exit(0 if right else 1)
        os._exit(2)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert parts(ahead.sample(8)) == expected


def test_a_prefetcher_does_one_thing_at_a_time():
    prefetcher, go, done = Prefetcher(), threading.Event(), []
    prefetcher.begin("a", lambda: go.wait(10) and done.append("a"))
    threading.Timer(0.05, go.set).start()
    prefetcher.begin("b", lambda: done.append("b") or "result")  # waits for a's end, and drops it
    assert done[0] == "a" and prefetcher.take("b") == "result" and prefetcher.take("b") is None
    prefetcher.close()


def test_the_order_of_a_copy_through_pinned_memory(monkeypatch):
    """Without a GPU: rows are written when the copy before is over, and used when this one is."""
    events = []

    class Event:
        def synchronize(self):
            events.append("wait for the copy before")

        def record(self, stream):
            events.append(f"record on {stream}")

    class Stream:
        def wait_event(self, event):
            events.append(f"the current stream waits for {type(event).__name__}")

    real_empty = th.empty
    monkeypatch.setattr(th, "empty", lambda *args, pin_memory, **kw: events.append(pin_memory) or real_empty(*args, **kw))
    monkeypatch.setattr(th.cuda, "Stream", lambda device: "side")
    monkeypatch.setattr(th.cuda, "Event", Event)
    monkeypatch.setattr(th.cuda, "stream", lambda stream: contextlib.nullcontext())
    monkeypatch.setattr(th.cuda, "current_stream", lambda device: Stream())
    monkeypatch.setattr(th.Tensor, "record_stream", lambda self, stream: events.append("keep"))
    real_to = th.Tensor.to
    monkeypatch.setattr(th.Tensor, "to", lambda self, _, non_blocking: events.append(non_blocking) or real_to(self, "cpu"))
    buffer = filled(make_buffer()).buffer
    transfer = gathering.PinnedTransfer(th.device("cuda"))
    assert type(gathering.make_transfer(th.device("cuda"))) is gathering.PinnedTransfer
    for turn in range(2):
        draws = buffer._draws(np.random.default_rng(turn), 6)
        expected = gathering.on_host(draws, 10)
        columns = transfer.ready(transfer.bring(draws, 10))
        assert all(np.array_equal(columns[name].numpy(), rows) for name, rows in expected.items())
    n = len(expected)
    once = ["wait for the copy before", *[True] * n, "record on side", "the current stream waits for Event", *["keep"] * n]
    assert events == [once[0], *[True] * n, *once[1:], *once]  # pinned memory is made once


# -- runs ------------------------------------------------------------------------------------------------------------------


def run(tiny_model, kwargs, steps=160, callback=None):
    scramble()
    model = tiny_model(vec_env(2), intrinsic_reward="lbs", replay_buffer_kwargs=kwargs, train_freq=2, gradient_steps=2)
    return model.learn(steps, callback=callback)


CHOICES = [STORES["device"], STORES["memory, prefetched"]]


@pytest.mark.parametrize("kwargs", CHOICES)
def test_a_run_is_the_same_in_every_store(tiny_model, tmp_path, kwargs):
    expected = everything(run(tiny_model, {}))
    model = run(tiny_model, kwargs, 80, RunCheckpointCallback(tmp_path / "run", 30))
    assert model.replay_buffer.store == kwargs.get("store", "memory")
    scramble()
    model = DreamerV2.resume(tmp_path / "run", vec_env(2), device="cpu")
    found = everything(model.learn(80, reset_num_timesteps=False))
    assert {name for name in expected if found[name] != expected[name]} == set()
    assert model.replay_buffer.store == kwargs.get("store", "memory")


def test_a_checkpoint_goes_from_one_store_to_another(tiny_model, tmp_path):
    expected = everything(run(tiny_model, {}))
    run(tiny_model, STORES["device"], 80, RunCheckpointCallback(tmp_path / "run", 30))
    model = DreamerV2.resume(tmp_path / "run", vec_env(2), device="cpu", replay_buffer_kwargs={"store": "memory"})
    found = everything(model.learn(80, reset_num_timesteps=False))
    assert {name for name in expected if found[name] != expected[name]} == set()


def test_replay_files(tiny_model, tmp_path):
    model = run(tiny_model, STORES["device"])
    model.save_replay_buffer(tmp_path / "replay")
    for kwargs in ({}, *CHOICES):
        other = run(tiny_model, kwargs, 20)
        other.load_replay_buffer(tmp_path / "replay")
        assert everything(other)["episodes"] == everything(model)["episodes"]
        assert parts(other.replay_buffer.sample(5)) == parts(copy.deepcopy(model.replay_buffer).sample(5))


def test_a_fine_tuning_gives_the_device_back(tiny_model):
    model = tiny_model(vec_env(), intrinsic_reward="lbs", replay_buffer_kwargs=STORES["device"])
    model.learn(50)
    old = model.replay_buffer
    model.learn(50, callback=PhaseSwitchCallback(60), reset_num_timesteps=False)
    assert model.phase == "finetuning" and model.replay_buffer is not old and len(old.episodes) == 0
    assert model.replay_buffer.store == "device" and len(model.replay_buffer.episodes) == 2


def test_the_choice_is_printed(tiny_model, capsys):
    tiny_model(verbose=1, replay_buffer_kwargs={"store": "device"})
    assert "Replay in the store 'device'" in capsys.readouterr().out


@pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("kwargs", [{"store": "auto"}, {"store": "device"}, {"store": "memory"}, {"prefetch": False}])
def test_on_a_gpu(kwargs):
    def buffer(device, kwargs):
        made = SequenceReplayBuffer(1500, IMAGE, ACTION, device, 3, batch_length=10, seed=0, **kwargs)
        return filled(made).buffer

    expected, mine = buffer("cpu", {"store": "memory"}), buffer("cuda", kwargs)
    on_device = kwargs.get("store", "auto") in ("auto", "device")
    assert (mine.store == "device") == on_device and mine.prefetches == (not on_device and kwargs.get("prefetch") is None)
    for _ in range(20):
        batch = mine.sample(40)
        mine.prefetch(40)
        assert batch.observation.device.type == "cuda" and parts(batch) == parts(expected.sample(40))
    mine.close()
