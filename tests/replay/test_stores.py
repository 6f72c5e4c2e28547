"""Replay on disk: the same rows and draws as in memory, after kills too; refusals; and how much will be needed."""

from __future__ import annotations

import builtins
import functools
import os
import re
import signal
import subprocess
import sys
import warnings

import numpy as np
import pytest
from fake_envs import CounterEnv
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from places import PYTHONPATH
from streams import ACTION, IMAGE, Streams, check_rows, decode, held, make_buffer
from whole_runs import SmallDisk, vec_env

from sb3_dreamer_urlb import DreamerV2, PhaseSwitchCallback, RunCheckpointCallback, SnapshotError
from sb3_dreamer_urlb.replay import SequenceReplayBuffer, stores
from sb3_dreamer_urlb.replay.lmdb_store import CHUNK, LmdbStore, ReplayStoreError


def on_disk(path, size=1500, **kwargs):
    return make_buffer(size, store="lmdb", path=path, **kwargs)


def filled(buffer, steps=800, lengths=(30, 61, 9, 10, 25, 50)):
    streams = Streams(buffer, lambda e: (lengths[e % len(lengths)], "terminal" if e % 2 else "truncated"))
    for _ in range(steps):
        streams.step()
    return streams


BIG = spaces.Box(0, 255, (3, 64, 64), np.uint8)


def fill_big(buffer, steps, length=30):
    """Rows of 12 kB; actions count."""
    zeros = np.zeros((1, 3, 64, 64), np.uint8)
    for t in range(1, steps):
        buffer.add(zeros, zeros, np.full((1, 2), t), np.zeros(1), np.array([t % length == 0]), [{}])


def contents(buffer):
    return [{name: rows.tobytes() for name, rows in e.rows(0, len(e)).items()} for e in buffer.episodes]


def counters(buffer):
    return buffer.evicted, buffer.finished_rows, buffer.finished_count, buffer.longest


@given(start=st.integers(0, 90), length=st.integers(1, 90))
def test_any_part_of_an_episode(tmp_path_factory, start, length):
    buffer = on_disk(tmp_path_factory.mktemp("part"), n_envs=1)
    filled(buffer, 90, (90,))
    episode = buffer.episodes[0]
    assert len(episode) == 91 and 91 % CHUNK
    stop = min(start + length, 91)
    rows = episode.rows(start, stop)
    assert np.array_equal(rows["action"][:, 1], np.arange(start, stop)) and len(rows["observation"]) == stop - start
    buffer.disk.close()


def test_rows_survive_the_process(tmp_path):
    streams = filled(on_disk(tmp_path))
    expected, numbers = contents(streams.buffer), counters(streams.buffer)
    streams.buffer.disk.close()
    again = on_disk(tmp_path)
    with pytest.warns(UserWarning, match=f"holds {numbers[1]} rows of an earlier run"):
        assert again.can_sample()
    assert contents(again) == expected and counters(again) == numbers
    check_rows(again.sample(100), held(streams))
    again.reset()
    assert not again.can_sample() and again.size() == 0


def a_writer(path: str) -> None:
    """What the subprocess below does until it is killed."""
    buffer = on_disk(path, n_envs=3)
    streams = Streams(buffer, lambda e: ((7 * e) % 60 + 9, "truncated"))
    while buffer.finished_count <= 40:
        streams.step()
    print("going", flush=True)
    while True:
        streams.step()


def test_kill_while_writing(tmp_path):
    """After each kill the file holds whole episodes, the newest that fit, none between missing."""
    path = PYTHONPATH
    environment = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    generator = np.random.default_rng(0)
    for kill in range(2):
        folder = tmp_path / str(kill)
        code = f"import test_stores as t; t.a_writer({str(folder)!r})"
        process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, env=environment)
        process.stdout.readline()
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(generator.uniform(0.1, 1.0))
        process.send_signal(signal.SIGKILL)
        process.wait()
        buffer = on_disk(folder, n_envs=3)
        with pytest.warns(UserWarning, match="earlier run"):
            assert buffer.can_sample()
        assert buffer.finished_count > 40 and buffer.finished_rows <= 1500
        check_rows(buffer.sample(200))
        for episode in buffer.episodes:
            numbers = episode.observation.reshape(len(episode), 4).astype(int)
            e, t = numbers[:, 0] + 256 * numbers[:, 1], numbers[:, 2] + 256 * numbers[:, 3]
            assert len(episode) == (7 * e[0]) % 60 + 10 and (e == e[0]).all() and np.array_equal(t, np.arange(len(episode)))
        assert len(set(decode(buffer.sample(200))[0][:, 0].tolist())) > 10


def test_the_file_is_bounded(tmp_path):
    buffer = SequenceReplayBuffer(
        10**6, BIG, ACTION, "cpu", 1, batch_length=10, seed=0, store="lmdb", path=tmp_path, map_size=4 << 20
    )
    fill_big(buffer, 1500)
    assert buffer.evicted > 10 and len(buffer.episodes) >= 4  # 31 rows of 12 kB each
    assert (tmp_path / "replay" / "data.mdb").stat().st_size <= 4 << 20
    # The newest are the ones that stayed.
    assert buffer.episodes[len(buffer.episodes) - 1].rows(1, 2)["action"][0, 0] == 1441
    assert buffer.sample(20).observation.shape == (20, 10, 3, 64, 64)


@pytest.mark.parametrize("length", [3, 7, 12, 19])
def test_a_full_file_goes_on(tmp_path, length):
    """Whatever little is left when an episode does not fit: there is room to remove others."""
    buffer = SequenceReplayBuffer(
        10**6, BIG, ACTION, "cpu", 1, batch_length=2, seed=0, store="lmdb", path=tmp_path, map_size=1 << 20
    )
    fill_big(buffer, 600, length)
    assert buffer.evicted > 10 and buffer.can_sample()
    assert (tmp_path / "replay" / "data.mdb").stat().st_size <= 1 << 20
    last = buffer.episodes[len(buffer.episodes) - 1]
    assert last.rows(len(last) - 1, len(last))["action"][0, 0] == 599 // length * length


def test_an_episode_larger_than_the_file(tmp_path):
    buffer = SequenceReplayBuffer(
        10**6, BIG, ACTION, "cpu", 1, batch_length=10, seed=0, store="lmdb", path=tmp_path, map_size=1 << 20
    )
    zeros = np.zeros((1, 3, 64, 64), np.uint8)
    with pytest.raises(ReplayStoreError, match="map_size=1048576 bytes are too few for one episode"):
        for t in range(200):
            buffer.add(zeros, zeros, np.zeros((1, 2)), np.zeros(1), np.array([t == 199]), [{}])


def test_a_full_disk_leaves_the_rows_there(tmp_path):
    disk = SmallDisk(tmp_path)  # 1 MB
    try:
        buffer = SequenceReplayBuffer(
            10**6, BIG, ACTION, "cpu", 1, batch_length=10, seed=0, store="lmdb", path=disk.folder, map_size=8 << 20
        )
        with pytest.raises(OSError, match=rf"\d+ bytes are free \(the replay stays as it was\): {disk.folder}"):
            fill_big(buffer, 600)
        held = len(buffer.episodes)
        assert held > 0 and buffer.sample(20).observation.shape[0] == 20
        for _ in range(2):
            buffer.episodes.popleft()  # it stays usable
        assert len(buffer.episodes) == held - 2
    finally:
        buffer.disk.close()
        disk.close()


# -- refusals --------------------------------------------------------------------------------------------------------------


def test_two_buffers_in_one_folder(tmp_path):
    first = filled(on_disk(tmp_path), 50).buffer
    with pytest.raises(ReplayStoreError, match=f"{tmp_path}/replay is in use by another run"):
        on_disk(tmp_path).can_sample()
    assert first.can_sample()


def test_rows_of_something_else_are_refused(tmp_path):
    filled(on_disk(tmp_path), 50).buffer.disk.close()
    wider = SequenceReplayBuffer(1500, IMAGE, spaces.Box(-1, 1, (3,)), "cpu", 3, batch_length=10, store="lmdb", path=tmp_path)
    with pytest.raises(ReplayStoreError, match=r"holds rows of another run: columns is .*Choose another path"):
        wider.can_sample()
    assert len(on_disk(tmp_path, phase="finetuning").episodes) == 0  # a folder of its own


@pytest.mark.parametrize("damage", ["cut", "emptied", "overwritten", "no cursor"])
def test_a_damaged_file_is_refused(tmp_path, damage):
    big = functools.partial(SequenceReplayBuffer, 500, BIG, ACTION, "cpu", 1, batch_length=10, store="lmdb", path=tmp_path)
    buffer = big()
    fill_big(buffer, 200)
    if damage == "no cursor":
        with buffer.disk.env.begin(write=True) as transaction:
            transaction.put(b"meta", b'{"first": 1e9')
    buffer.disk.close()
    file = tmp_path / "replay" / "data.mdb"
    size = file.stat().st_size
    if damage == "cut":
        os.truncate(file, size // 2)
    elif damage == "overwritten":
        file.write_bytes(b"\xff" * size)
    elif damage == "emptied":
        os.truncate(file, 100)
    with pytest.raises(ReplayStoreError, match=f"{re.escape(str(tmp_path))}.*(damaged|cannot be opened)"):
        big().can_sample()


def test_missing_rows_are_an_error_that_names_them(tmp_path):
    buffer = filled(on_disk(tmp_path)).buffer
    episode = buffer.episodes[0]
    with buffer.disk.env.begin(write=True) as transaction:
        buffer.disk._delete(transaction, episode.number, len(episode))
    with pytest.raises(ReplayStoreError, match=f"rows 0 on of episode {episode.number} are missing"):
        episode.rows(0, 5)


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"store": "disk"}, r"store must be one of \['auto', 'memory', 'device', 'lmdb'\], got 'disk'"),
        ({"store": "lmdb"}, "path=None: a path is for store='lmdb', which needs one"),
        ({"path": "x"}, "path='x': a path is for store='lmdb'"),
        ({"map_size": 1 << 30}, "map_size .* is for store='lmdb' only"),
        ({"store": "lmdb", "path": "x", "map_size": 5}, "map_size must be at least 1048576 bytes.*got 5"),
        ({"store": "device", "path": "x"}, "path='x': a path is for store='lmdb'"),
        ({"store": "device", "prefetch": True}, "prefetch=True and store='device': rows that are on the device need no"),
        ({"prefetch": "yes"}, "prefetch must be True, False or None, got 'yes'"),
    ],
)
def test_arguments(tiny_model, kwargs, message):
    with pytest.raises(ValueError, match=message):
        tiny_model(replay_buffer_kwargs=kwargs)


def test_without_the_package(monkeypatch, tmp_path):
    real = builtins.__import__
    monkeypatch.setattr(
        builtins, "__import__", lambda name, *a: (_ for _ in ()).throw(ModuleNotFoundError("No module named 'lmdb'"))
        if name == "lmdb" else real(name, *a)
    )  # fmt: skip
    with pytest.raises(
        ModuleNotFoundError, match=r"store='lmdb' needs a package; in a clone of the repository: pip install '\.\[lmdb\]'"
    ):
        on_disk(tmp_path)


# -- how much will be needed -----------------------------------------------------------------------------------------------


def test_a_buffer_beyond_memory_warns_before_the_run(tiny_model, monkeypatch):
    monkeypatch.setattr(stores, "_memory", lambda: 10**9)
    row = 3 * 16 * 16 + 2 * 4 + 4 + 1
    with pytest.warns(UserWarning, match=rf"buffer_size=2000000 rows of {row} bytes will take 1.6 GB, but there are 1.0 GB"):
        tiny_model(buffer_size=2_000_000)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tiny_model(buffer_size=1_000_000)


def test_a_buffer_beyond_the_disk_warns(tiny_model, tmp_path):
    with pytest.warns(UserWarning, match=f"GB of free space in {tmp_path}. Choose a smaller buffer_size"):
        tiny_model(buffer_size=10**13, replay_buffer_kwargs={"store": "lmdb", "path": tmp_path / "new" / "replay"})


def test_the_memory_of_this_machine():
    assert 1e8 < stores._memory() < 1e14


# -- runs ------------------------------------------------------------------------------------------------------------------


def test_a_run_on_disk_resumes_with_the_rows_of_its_checkpoint(tiny_model, tmp_path):
    kwargs = {"replay_buffer_kwargs": {"store": "lmdb", "path": tmp_path / "replay"}, "intrinsic_reward": "lbs"}
    model = tiny_model(vec_env(2), **kwargs)
    model.learn(120, callback=RunCheckpointCallback(tmp_path / "run"))
    expected = contents(model.replay_buffer)
    model.learn(80, reset_num_timesteps=False)  # after the checkpoint
    assert len(contents(model.replay_buffer)) > len(expected)
    model.replay_buffer.disk.close()
    assert not list((tmp_path / "run" / "replay").glob("[0-9]*[0-9].zip"))  # nothing is stored twice
    resumed = DreamerV2.resume(tmp_path / "run", vec_env(2), device="cpu")
    assert resumed.num_timesteps == 120 and contents(resumed.replay_buffer) == expected
    resumed.learn(80, reset_num_timesteps=False, callback=RunCheckpointCallback(tmp_path / "run"))
    assert len(resumed.replay_buffer.episodes) > len(expected)


def test_what_left_after_a_checkpoint_stays_until_the_next(tmp_path):
    """Three checkpoints' worth of rows pass through a file; each time the last checkpoint can be gone back to."""
    buffer = on_disk(tmp_path, n_envs=1)
    for _ in range(3):
        filled(buffer, 1600)
        buffer.close_streams()
        buffer.disk.release(buffer.evicted)
        assert buffer.disk.held == []
        expected, numbers = contents(buffer), counters(buffer)
        end = buffer.evicted + len(buffer.episodes)
        filled(buffer, 700)
        assert buffer.evicted > numbers[0] and len(buffer.disk.held) == buffer.evicted - numbers[0]
        buffer.disk.close()
        buffer = on_disk(tmp_path, n_envs=1)
        buffer.attach(taking_over=True)
        buffer.roll_back(end, {"evicted": numbers[0], "finished_count": numbers[2], "longest": numbers[3]})
        assert contents(buffer) == expected and counters(buffer) == numbers


@pytest.mark.parametrize("length", [3, 12, 19])
def test_without_room_for_what_left_a_run_goes_on(tmp_path, length):
    """``map_size`` bounds everything; what the checkpoint lost by it is said when the run is resumed."""
    buffer = SequenceReplayBuffer(
        40, BIG, ACTION, "cpu", 1, batch_length=2, seed=0, store="lmdb", path=tmp_path, map_size=1 << 20
    )
    fill_big(buffer, 50, length)
    buffer.disk.release(buffer.evicted)
    first, end = buffer.evicted, buffer.evicted + len(buffer.episodes)
    fill_big(buffer, 600, length)
    assert (tmp_path / "replay" / "data.mdb").stat().st_size <= 1 << 20 and buffer.can_sample()
    with pytest.warns(UserWarning, match=rf"{end - first} episodes that the checkpoint drew from .*not bit for bit"):
        buffer.roll_back(end, {"evicted": first, "finished_count": 5, "longest": 5})
    assert not buffer.can_sample()
    fill_big(buffer, 100, length)
    assert buffer.can_sample() and buffer.evicted >= end


def test_a_fine_tuning_does_not_see_the_pre_trainings_rows(tiny_model, tmp_path):
    model = tiny_model(CounterEnv(20), intrinsic_reward="lbs", replay_buffer_kwargs={"store": "lmdb", "path": str(tmp_path)})
    model.learn(100, callback=PhaseSwitchCallback(60, CounterEnv(20)))
    assert model.phase == "finetuning" and model.replay_buffer.finished_count == 2
    assert sorted(folder.name for folder in tmp_path.iterdir()) == ["finetuning", "pretraining"]


def test_whoever_only_looks_at_a_model_leaves_the_file_alone(tiny_model, tmp_path):
    kwargs = {"store": "lmdb", "path": str(tmp_path / "replay")}
    model = tiny_model(vec_env(), replay_buffer_kwargs=kwargs).learn(60)
    model.save(tmp_path / "model")
    other = DreamerV2.load(tmp_path / "model", env=vec_env(), device="cpu")  # while the first still learns
    other.predict(other.get_env().reset())
    with pytest.raises(SnapshotError, match="the model keeps its replay on disk"):
        model.save_replay_buffer(tmp_path / "replay.pkl")
        other.load_replay_buffer(tmp_path / "replay.pkl")
    assert isinstance(model.replay_buffer.disk, LmdbStore) and other.replay_buffer.disk is None


def test_a_checkpoint_of_another_store_is_refused(tiny_model, tmp_path):
    tiny_model(vec_env()).learn(60, callback=RunCheckpointCallback(tmp_path / "run"))
    kwargs = {"store": "lmdb", "path": str(tmp_path / "replay")}
    with pytest.raises(SnapshotError, match="its replay is kept in another store"):
        DreamerV2.resume(tmp_path / "run", vec_env(), replay_buffer_kwargs=kwargs)
