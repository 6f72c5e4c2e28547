"""``learn`` that goes on with a run where a callback asks for it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback, CallbackList

from sb3_dreamer_urlb.runs import run_folder
from sb3_dreamer_urlb.runs.running_algorithm import RunningAlgorithm
from sb3_dreamer_urlb.snapshots.model_data import describe_arguments
from sb3_dreamer_urlb.snapshots.values import contains_custom, decode


class ResumingCallback(BaseCallback):
    """A callback that may ask ``learn`` to go on with a run before it does anything else."""

    #: of the run
    folder: Path
    #: ``"auto"`` asks for it
    resume: str | None


def resume_if_asked(model: RunningAlgorithm, callback: Any) -> bool:
    """Go on with a run where a :class:`ResumingCallback` says ``resume="auto"``; before ``learn`` does anything.

    :param model: about to learn; becomes the checkpoint's
    :param callback: what ``learn`` was given
    :return: whether a run goes on
    :raises ValueError: if it is one of other arguments
    :raises SnapshotError: naming the file and why it is refused
    """
    callbacks = _flat(callback)
    asked = [one for one in callbacks if isinstance(one, ResumingCallback) and one.resume == "auto"]
    if not asked or not _go_on(model, asked[0].folder):
        return False
    if asked[0].verbose >= 1:
        print(f"Going on with the run in {asked[0].folder} after {model.num_timesteps} steps.")
    for one in callbacks:
        # What is due every so many steps stays so.
        one.n_calls = one.n_calls or model.num_timesteps // model.n_envs
    return True


def _flat(callback: Any) -> list[BaseCallback]:
    if isinstance(callback, list | tuple):
        return [one for inner in callback for one in _flat(inner)]
    if isinstance(callback, CallbackList):
        return _flat(callback.callbacks)
    return [callback] if isinstance(callback, BaseCallback) else []


def _go_on(model: RunningAlgorithm, folder: Path) -> bool:
    mine = model.run_folder
    if mine is not None and mine.path.resolve() == folder.resolve():
        # resume() has been here; and from the second learn() on, steps count as ever.
        return mine.resumed and not mine.begun
    if model.phase_timesteps > 0:
        return False  # it has a life of its own
    arguments = describe_arguments(model)
    own = model.arguments()
    given = {name: own[name] for name, value in arguments.items() if contains_custom(decode(value)) is not None}
    kwargs = {"verbose": model.verbose, "tensorboard_log": model.tensorboard_log}
    options = {"device": model.device, "print_system_info": False, "kwargs": kwargs}
    resumed = run_folder.resume(type(model), folder, model.get_env(), custom_objects=given, **options)
    if resumed is None:
        return False
    found, folder_of_it = resumed
    found.run_folder = folder_of_it
    for name, value in describe_arguments(found).items():
        if value != arguments[name]:
            raise ValueError(
                f"The run in {folder} has {name}={found.arguments()[name]!r}, the model {own[name]!r}: with "
                f"resume='auto' a run keeps its arguments. {type(model).__name__}.resume(folder, env, ...) takes others."
            )
    # Everything is the run's, but for what belongs to this call of learn.
    state: dict[str, Any] = dict(vars(found))
    state |= {name: value for name, value in vars(model).items() if name in ("during_learn", "_logger", "_custom_logger")}
    vars(model).clear()
    vars(model).update(state)
    return True
