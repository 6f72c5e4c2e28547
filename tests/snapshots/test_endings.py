"""What files end in, and that no kind of file takes the place of another."""

from __future__ import annotations

import pytest


@pytest.fixture
def model(tiny_model):
    return tiny_model().learn(30)


def test_replays_end_in_zip_and_pkl_is_still_read(model, tmp_path):
    model.save_replay_buffer(tmp_path / "replay")
    assert [path.name for path in tmp_path.iterdir()] == ["replay.zip"]
    rows = model.replay_buffer.size()
    model.load_replay_buffer(tmp_path / "replay")
    assert model.replay_buffer.size() == rows
    (tmp_path / "replay.zip").rename(tmp_path / "old.pkl")
    for name in ("old", "old.pkl"):
        model.load_replay_buffer(tmp_path / name)
    with pytest.raises(FileNotFoundError):
        model.load_replay_buffer(tmp_path / "replay")


def test_of_two_the_new_one_is_read(model, tmp_path):
    model.save_replay_buffer(tmp_path / "replay.zip")
    (tmp_path / "replay.pkl").write_bytes(b"none")
    model.load_replay_buffer(tmp_path / "replay")


def test_nothing_takes_the_place_of_another_kind(model, tmp_path):
    savers = {"model": model.save, "policy": model.policy.save, "replay": model.save_replay_buffer}
    for kind, save in savers.items():
        path = tmp_path / f"{kind}.zip"
        save(path)
        save(path)
        before = path.read_bytes()
        for other, its in savers.items():
            if other != kind:
                with pytest.raises(FileExistsError, match=f"A {other} does not take the place of a {kind}"):
                    its(path)
        assert path.read_bytes() == before
    model.save(tmp_path / "walker")
    with pytest.raises(FileExistsError):
        model.save_replay_buffer(tmp_path / "walker")
