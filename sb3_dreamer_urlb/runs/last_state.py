"""The last good state of a run that is about to end with an error."""

from __future__ import annotations

from pathlib import Path

from sb3_dreamer_urlb.runs.running_algorithm import RunningAlgorithm


def save_last_good_state(model: RunningAlgorithm) -> str:
    """Write a checkpoint where a RunCheckpointCallback keeps the run, else a snapshot into the folder of the log.

    :param model: whose weights are finite
    :return: a sentence that says where it is, or why there is none
    """
    try:
        if model.checkpoint is not None:
            return f"The last good state is in {model.checkpoint()}."
        path = Path(model.logger.get_dir() or ".").resolve() / f"last_good_state_{model.num_timesteps}.zip"
        model.save(path)
        return f"The last good state is in {path}."
    except (OSError, ValueError) as error:
        return f"The last good state could not be written: {error}"
