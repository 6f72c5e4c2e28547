"""A file where a folder is wanted."""

from __future__ import annotations

from pathlib import Path

import pytest
from fake_envs import CounterEnv

from sb3_dreamer_urlb import DreamerV2, DrQv2, EvaluationCallback, RunCheckpointCallback, SnapshotCallback, VideoCallback
from sb3_dreamer_urlb.analysis.study_settings import remember
from sb3_dreamer_urlb.analysis.trajectories import save_trajectories
from sb3_dreamer_urlb.cli.methods_tour import TourConfig, run_tour
from sb3_dreamer_urlb.evaluation.append import append_rows
from sb3_dreamer_urlb.folders import check_file, check_folder, made_folder
from sb3_dreamer_urlb.runs.run_folder import RunFolder


@pytest.mark.parametrize("path", [5, None, ["a"]])
def test_what_is_no_path_is_named(path):
    with pytest.raises(ValueError, match="folder must be the path of a folder, got"):
        check_folder("folder", path)
    with pytest.raises(ValueError, match="folder must be the path of a folder, got"):
        RunCheckpointCallback(path)


def model(algorithm=DreamerV2, **kwargs):
    return algorithm("CnnPolicy", CounterEnv(), preset="tiny", device="cpu", **kwargs)


TAKERS = {
    "save_path": lambda path: SnapshotCallback(path, frames=[10]),
    "folder": lambda path: VideoCallback(folder=path),
    "folder, of a checkpoint": RunCheckpointCallback,
    "folder, of a run": lambda path: RunFolder(path).locked().__enter__(),
    "tensorboard_log": lambda path: model(tensorboard_log=path),
    "tensorboard_log, of the other algorithm": lambda path: model(DrQv2, tensorboard_log=path),
    "replay_buffer_kwargs: path": lambda path: model(replay_buffer_kwargs={"store": "lmdb", "path": path}),
    "best_model_save_path": lambda path: model().learn(
        1, callback=EvaluationCallback(CounterEnv(), best_model_save_path=path)
    ),
    "log_path": lambda path: model().learn(1, callback=EvaluationCallback(CounterEnv(), log_path=path)),
    "the folder of a file": lambda path: model().save(f"{path}/model.zip"),
    "the folder of the rows": lambda path: append_rows(f"{path}/rows.csv", []),
    "--out": lambda path: run_tour(TourConfig(out=Path(path))),
    "folder, of trajectories": lambda path: save_trajectories([], path),
    "folder, of a study": lambda path: remember(Path(path), {}),
}


@pytest.mark.parametrize("taker", TAKERS)
def test_whoever_takes_a_folder_says_that_a_file_is_there(tmp_path, taker):
    file = tmp_path / "text.zip"
    file.write_text("mine")
    argument = taker.partition(",")[0]
    with pytest.raises(
        NotADirectoryError, match=f"^{argument} must be the path of a folder, got '{file}': a file of that name"
    ):
        TAKERS[taker](str(file))
    with pytest.raises(NotADirectoryError, match=f"^{argument} must be .* got '{file}/inner': '{file}' is a file"):
        TAKERS[taker](str(file / "inner"))
    assert file.read_text() == "mine"


def test_folders_are_made_where_they_are_missing(tmp_path):
    path = tmp_path / "a" / "b"
    check_folder("folder", path)
    assert not path.parent.exists()
    for _ in range(2):
        assert made_folder("folder", str(path)) == path and path.is_dir()


def test_a_folder_where_a_file_is_wanted(tmp_path):
    with pytest.raises(IsADirectoryError, match=f"^--out must be the path of a file, got '{tmp_path}': that is a folder"):
        check_file("--out", tmp_path)
    check_file("--out", tmp_path / "a" / "b.html")
    assert not list(tmp_path.iterdir())
