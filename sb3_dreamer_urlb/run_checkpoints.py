"""The callback that keeps a run in a folder, and lets it end cleanly on a signal."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback

from sb3_dreamer_urlb.run_folder import RunFolder

if TYPE_CHECKING:
    from sb3_dreamer_urlb.dreamer_v2 import DreamerV2


class RunCheckpointCallback(BaseCallback):
    """Keep a run in a folder, so that ``DreamerV2.resume(folder, env)`` goes on with it after whatever killed it.

    Checkpoints are taken between rollouts. Holds the folder's lock while learning. On SIGTERM or SIGINT the step is
    finished, a checkpoint written, and the process exits (``SystemExit``, ``KeyboardInterrupt``); a second signal exits at
    once.

    :param folder: of the run; its own, new or resumed
    :param every_frames: environment frames between two checkpoints
    :param evaluation: whose best result and schedule the run should remember
    :param handle_signals: False leaves SIGTERM and SIGINT alone
    :param verbose: 1 prints each checkpoint
    :raises ValueError: for a number of frames that is not positive, and, when ``learn`` begins, for a folder with a run that
        the model was not resumed from
    :raises RuntimeError: when ``learn`` begins, if another run is in the folder
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        every_frames: int = 20_000,
        evaluation: EvalCallback | None = None,
        handle_signals: bool = True,
        verbose: int = 0,
    ):
        super().__init__(verbose)
        if every_frames < 1:
            raise ValueError(f"every_frames must be positive, got {every_frames}.")
        self.folder = Path(folder)
        self.every_frames = every_frames
        self.evaluation = evaluation
        self.handle_signals = handle_signals
        self.received: int | None = None
        self._saved: tuple[Any, ...] | None = None

    def _init_callback(self) -> None:
        model: DreamerV2 = self.model  # type: ignore[assignment]
        run = model.run_folder
        if run is None or run.path.resolve() != self.folder.resolve():
            run = RunFolder(self.folder)
        model.during_learn.enter_context(run.locked())
        if not run.is_current():
            raise ValueError(
                f"{self.folder} holds another run. To go on with it: DreamerV2.resume({str(self.folder)!r}, env); "
                "for a new run choose another folder."
            )
        model.run_folder = self.run = run
        model.checkpoint = self._checkpoint
        model.during_learn.callback(setattr, model, "checkpoint", None)
        self._saved = None if run.identity is None else self._state()
        self.received = None
        if self.evaluation is not None and run.evaluation is not None:
            self.evaluation.best_mean_reward = run.evaluation["best_mean_reward"]
            self.evaluation.n_calls = run.evaluation["n_calls"]
            run.evaluation = None
        if self.handle_signals and threading.current_thread() is threading.main_thread():
            model.during_learn.enter_context(self._watching())

    @contextmanager
    def _watching(self) -> Iterator[None]:
        before = {number: signal.signal(number, self._on_signal) for number in (signal.SIGTERM, signal.SIGINT)}
        try:
            yield
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)

    def _on_signal(self, number: int, _: Any) -> None:
        if self.received is not None:
            signal.signal(number, signal.SIG_DFL)
            os.kill(os.getpid(), number)
        self.received = number

    def _state(self) -> tuple[Any, ...]:
        model: DreamerV2 = self.model  # type: ignore[assignment]
        return model.phase, model.phase_frames, model._n_updates

    def _on_rollout_start(self) -> None:
        phase, frames, _ = self._state()
        if self._saved is None or self._saved[0] != phase or frames - self._saved[1] >= self.every_frames:
            self._save()

    def _on_step(self) -> bool:
        return self.received is None

    def _on_training_end(self) -> None:
        if self._saved != self._state():
            self._save()
        if self.received == signal.SIGINT:
            raise KeyboardInterrupt
        if self.received is not None:
            raise SystemExit(128 + self.received)

    def _checkpoint(self) -> Path:
        self._save()
        return self.folder

    def _save(self) -> None:
        evaluation = None
        if self.evaluation is not None and np.isfinite(self.evaluation.best_mean_reward):
            evaluation = {
                "best_mean_reward": float(self.evaluation.best_mean_reward),
                "n_calls": int(self.evaluation.n_calls),
            }
        self.run.save(self.model, evaluation)  # type: ignore[arg-type]
        self._saved = self._state()
        if self.verbose >= 1:
            print(f"Checkpoint {self.run.number} in {self.folder}: {self._saved[0]}, {self._saved[1]} frames")
