"""Callbacks for rl_zoo3's YAML files, which give keyword arguments and do not know the folder of the run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback

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


class BestOfPhase(BaseCallback):
    """Lets Stable-Baselines3's evaluation begin anew with each phase: an agent that explores is no best one of the task's.

    :param evaluation: which stands behind this one
    """

    def __init__(self, evaluation: EvalCallback):
        super().__init__()
        self.evaluation = evaluation
        self.phase = ""

    def _init_callback(self) -> None:
        self.phase = self.model.phase  # type: ignore[attr-defined] # it has phases

    def _on_step(self) -> bool:
        phase = self.model.phase  # type: ignore[attr-defined]
        if phase != self.phase:
            self.phase, self.evaluation.best_mean_reward = phase, -np.inf
        return True
