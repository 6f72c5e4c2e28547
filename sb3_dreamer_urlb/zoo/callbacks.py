"""Callbacks for rl_zoo3's YAML files, which give keyword arguments and do not know the folder of the run."""

from __future__ import annotations

from collections.abc import Sequence

from sb3_dreamer_urlb.callbacks.snapshot import SNAPSHOT_FRAMES, SnapshotCallback


class RunSnapshotCallback(SnapshotCallback):
    """Snapshots of the pre-training in ``<folder of the run>/snapshots``.

    A folder of their own, because rl_zoo3's ``-i`` loads a ``replay_buffer.pkl`` that lies beside a snapshot. A run
    without a folder (``-optimize``) saves none.

    :param frames: when, in environment frames of the pre-training
    :param name_prefix: of the files
    :param verbose: 1 prints each path
    :raises ValueError: for numbers of frames that are not positive
    """

    def __init__(
        self,
        frames: Sequence[int] = SNAPSHOT_FRAMES,
        name_prefix: str = "snapshot",
        verbose: int = 1,
    ):
        super().__init__("", frames, name_prefix, verbose)

    def _init_callback(self) -> None:
        if self.save_path:
            super()._init_callback()
