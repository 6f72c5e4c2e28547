"""The callback that saves pre-trained agents on the way (paper §2)."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from stable_baselines3.common.callbacks import BaseCallback

from sb3_dreamer_urlb.algorithm import PhasedAlgorithm
from sb3_dreamer_urlb.folders import check_folder, made_folder
from sb3_dreamer_urlb.number_checks import is_integer
from sb3_dreamer_urlb.phases import PRETRAINING
from sb3_dreamer_urlb.signatures import WithKnownKeywords
from sb3_dreamer_urlb.snapshots.vec_normalize import beside, save_vec_normalize

#: when the paper saves its pre-trained agents, in environment frames
SNAPSHOT_FRAMES = (100_000, 500_000, 1_000_000, 2_000_000)


class SnapshotCallback(WithKnownKeywords, BaseCallback):
    """Save the pre-training agent whenever it has seen given numbers of frames (paper §2).

    Files are called ``<name_prefix>_<frames>.zip``; beside each, where the environment is a ``VecNormalize``, its statistics:
    ``<name_prefix>_<frames>.vec_normalize.json``.

    :param save_path: folder, made if it does not exist
    :param frames: when, in environment frames of the pre-training
    :param name_prefix: of the files
    :param verbose: 1 prints each path
    :raises ValueError: for numbers of frames that are not positive
    :raises NotADirectoryError: if ``save_path`` is a file
    """

    def __init__(
        self,
        save_path: str | os.PathLike[str],
        frames: Sequence[int] = SNAPSHOT_FRAMES,
        name_prefix: str = "snapshot",
        verbose: int = 0,
    ):
        super().__init__(verbose)
        if not isinstance(frames, Sequence) or any(not is_integer(frame) or frame < 1 for frame in frames):
            raise ValueError(f"frames must be a sequence of positive integers, got {frames!r}.")
        check_folder("save_path", save_path)
        self.save_path = os.fspath(save_path)
        self.frames = sorted(frames)
        self.name_prefix = name_prefix
        self.pending: list[int] = []

    def _init_callback(self) -> None:
        made_folder("save_path", self.save_path)
        model: PhasedAlgorithm = self.model  # type: ignore[assignment]
        self.pending = [frame for frame in self.frames if frame > model.phase_frames]

    def _on_step(self) -> bool:
        model: PhasedAlgorithm = self.model  # type: ignore[assignment]
        if model.phase != PRETRAINING:
            return True
        while self.pending and model.phase_frames >= self.pending[0]:
            path = os.path.join(self.save_path, f"{self.name_prefix}_{self.pending.pop(0)}.zip")
            model.save(path)
            if (normalizer := model.get_vec_normalize_env()) is not None:
                save_vec_normalize(normalizer, beside(Path(path)))
            if self.verbose >= 1:
                print(f"Saved {path}")
        return True
