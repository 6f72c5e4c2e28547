"""The callback that keeps a run in a folder, goes on with it, and lets it end cleanly on a signal."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import EvalCallback

from sb3_dreamer_urlb.algorithm import PhasedAlgorithm
from sb3_dreamer_urlb.callbacks.placing import BetweenRolloutsCallback
from sb3_dreamer_urlb.folders import check_folder
from sb3_dreamer_urlb.number_checks import check_integer
from sb3_dreamer_urlb.runs import evaluation_history
from sb3_dreamer_urlb.runs.resuming import ResumingCallback
from sb3_dreamer_urlb.runs.run_folder import RunFolder
from sb3_dreamer_urlb.signatures import WithKnownKeywords


class RunCheckpointCallback(WithKnownKeywords, BetweenRolloutsCallback, ResumingCallback):
    """Keep a run in a folder, so that it can go on after whatever killed it.

    With ``resume="auto"`` the same script, started again, does so: when ``learn`` begins and the folder holds a checkpoint,
    the new model becomes the one of the checkpoint, and ``total_timesteps`` counts the whole run. Without, that is up to
    ``DreamerV2.resume(folder, env)``.

    Checkpoints are taken between rollouts. Holds the folder's lock while learning. On SIGTERM or SIGINT the step is
    finished, a checkpoint written, and the process exits (``SystemExit``, ``KeyboardInterrupt``); a second signal exits at
    once.

    :param folder: of the run; its own, new or resumed
    :param every_frames: environment frames between two checkpoints
    :param evaluation: whose best result and schedule the run should remember
    :param handle_signals: False leaves SIGTERM and SIGINT alone
    :param verbose: 1 prints each checkpoint, and where a run goes on
    :param resume: ``"auto"``, or None to leave a run that is there alone
    :raises ValueError: for arguments that do not fit, and, when ``learn`` begins, for a folder with a run that the model was
        not resumed from, or, with ``resume="auto"``, one of other arguments
    :raises RuntimeError: when ``learn`` begins, if another run is in the folder
    """

    def __init__(
        self,
        folder: str | os.PathLike[str],
        every_frames: int = 20_000,
        evaluation: EvalCallback | None = None,
        handle_signals: bool = True,
        verbose: int = 0,
        resume: str | None = None,
    ):
        super().__init__(verbose)
        check_integer("every_frames", every_frames, 1)
        if resume not in (None, "auto"):
            raise ValueError(f"resume must be 'auto' or None, got {resume!r}.")
        self.resume = resume
        check_folder("folder", folder)
        if evaluation is not None and not isinstance(evaluation, EvalCallback):
            raise ValueError(f"evaluation must be an EvalCallback or None, got {evaluation!r}.")
        self.folder = Path(folder)
        self.every_frames = every_frames
        self.evaluation = evaluation
        self.handle_signals = handle_signals
        self.received: int | None = None
        self._saved: tuple[Any, ...] | None = None

    def _init_callback(self) -> None:
        model: PhasedAlgorithm = self.model  # type: ignore[assignment]
        run = model.run_folder
        if run is None or run.path.resolve() != self.folder.resolve():
            run = RunFolder(self.folder)
        model.during_learn.enter_context(run.locked())
        if not run.is_current():
            raise ValueError(
                f"{self.folder} holds another run. To go on with it: RunCheckpointCallback(..., resume='auto') with a new "
                f"model, or {type(model).__name__}.resume({str(self.folder)!r}, env); for a new run choose another folder."
            )
        if run.lost_its_checkpoint():
            raise ValueError(
                f"{self.folder} holds the replay of a run without its checkpoint: put {run.snapshot.name} back, or choose "
                "another folder. A run that begins here would remove that replay."
            )
        model.run_folder = self.run = run
        run.begun = True
        model.checkpoint = self._checkpoint
        model.during_learn.callback(setattr, model, "checkpoint", None)
        self._saved = None if run.identity is None else self._state()
        self.received = None
        if self.evaluation is not None and run.evaluation is not None:
            evaluation_history.restore(self.evaluation, run.evaluation, model.num_timesteps)
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
        model: PhasedAlgorithm = self.model  # type: ignore[assignment]
        return model.phase, model.phase_frames, model._n_updates

    def _on_rollout_start(self) -> None:
        phase, frames, _ = self._state()
        if self._saved is None or self._saved[0] != phase or frames - self._saved[1] >= self.every_frames:
            self._save()

    def _on_step(self) -> bool:
        return self.received is None

    def _on_training_end(self) -> None:
        model: PhasedAlgorithm = self.model  # type: ignore[assignment]
        # rl_zoo3 calls this once more when the folder is not ours any longer.
        if model.checkpoint is None:
            return
        if self._saved != self._state():
            self._save()
        received, self.received = self.received, None
        if received == signal.SIGINT:
            raise KeyboardInterrupt
        if received is not None:
            raise SystemExit(128 + received)

    def _checkpoint(self) -> Path:
        self._save()
        return self.folder

    def _save(self) -> None:
        self.run.save(self.model, evaluation_history.state(self.evaluation))  # type: ignore[arg-type]
        self._saved = self._state()
        if self.verbose >= 1:
            print(f"Checkpoint {self.run.number} in {self.folder}: {self._saved[0]}, {self._saved[1]} frames")
