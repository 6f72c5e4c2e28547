"""What a run needs to know of an algorithm: where it is kept, and what lasts as long as ``learn``."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from sb3_dreamer_urlb.runs.run_folder import RunFolder
from sb3_dreamer_urlb.snapshots.saved_algorithm import SavedAlgorithm


class RunningAlgorithm(SavedAlgorithm):
    """An algorithm whose runs may be kept in a folder, to go on after whatever killed them."""

    #: agent steps in the phase, which no ``learn`` resets
    phase_timesteps: int
    #: where the run is kept, None unless a RunCheckpointCallback does
    run_folder: RunFolder | None
    #: writes a checkpoint of the run now and returns its folder; None unless a RunCheckpointCallback is at work
    checkpoint: Callable[[], Path] | None
    #: what callbacks want undone when ``learn`` ends, however it ends
    during_learn: ExitStack
