"""Checks of what users hand to any algorithm of this package: one clear error, before any time is spent."""

from __future__ import annotations

import os
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise

from sb3_dreamer_urlb.folders import check_folder
from sb3_dreamer_urlb.learning.graphs import COMPILE
from sb3_dreamer_urlb.nn.precision import PRECISIONS
from sb3_dreamer_urlb.number_checks import (
    check_choice,
    check_dict,
    check_integer,
    check_switch,
    is_finite_number,
    is_integer,
    is_number,
)
from sb3_dreamer_urlb.phases import PHASES, PRETRAINING
from sb3_dreamer_urlb.replay import SequenceReplayBuffer
from sb3_dreamer_urlb.signatures import named_parameters
from sb3_dreamer_urlb.snapshots.saved_algorithm import SavedAlgorithm
from sb3_dreamer_urlb.unknown_names import UnknownNameError, check_keys, unexpected_arguments

#: arguments of every replay that the algorithm fills in itself
REPLAY_ARGUMENTS_OF_THE_MODEL = {
    "buffer_size", "observation_space", "action_space", "device", "n_envs", "batch_length", "phase", "skill_size", "tasks",
}  # fmt: skip
#: constructor arguments that change nothing of a file, and what does
NOT_CHANGED = {
    "preset": "presets fill in what a constructor is not told, and a file tells everything. Write the arguments to change, or "
    "make a new model, {me}(..., preset=...)",
    "policy": "a file says which it holds. A class that no file can hold is given with custom_objects={{'policy': ...}}",
}
#: range of a number: (low, low allowed, high, high allowed)
Range = tuple[float, bool, float, bool]


def check_verbose(verbose: Any) -> None:
    """Before Stable-Baselines3 compares it with numbers.

    :raises ValueError: for anything but 0, 1 and 2
    """
    if not is_integer(verbose) or not 0 <= verbose <= 2:
        raise ValueError(f"verbose must be 0, 1 or 2, got {verbose!r}.")


def check_learn(total_timesteps: Any, log_interval: Any, callback: Any = None, **switches: Any) -> None:
    """What ``learn`` is told, before Stable-Baselines3 compares and divides with it, and calls it.

    :param total_timesteps: agent steps
    :param log_interval: episodes between two log lines; None for no lines
    :param callback: one, several in a list, or None
    :param switches: what is true or false, by name
    :raises ValueError: for what is no such number, callback or switch
    """
    for one in callback if isinstance(callback, list) else []:
        if not isinstance(one, BaseCallback):
            raise ValueError(f"callback must be a list of callbacks of Stable-Baselines3, got one with {one!r}.")
    known = callback is None or isinstance(callback, list | BaseCallback)
    if not known and (isinstance(callback, type) or not callable(callback)):
        raise ValueError(
            f"callback must be a callback of Stable-Baselines3, a function, or a list of callbacks, got {callback!r}."
        )
    if not is_number(total_timesteps) or not total_timesteps >= 0:
        raise ValueError(f"total_timesteps must be a number of agent steps, 0 or more, got {total_timesteps!r}.")
    if log_interval is not None:
        check_integer("log_interval", log_interval, 1)
    for name, value in switches.items():
        check_switch(name, value)


def check_settings(model: SavedAlgorithm) -> None:
    """What is not an algorithm's own, but Stable-Baselines3's: it takes anything, and fails later.

    :param model: with its arguments, nothing built
    :raises ValueError: naming the argument, its value and what was expected
    """
    check_integer("stats_window_size", model._stats_window_size, 1)
    if model.seed is not None and not (is_integer(model.seed) and 0 <= model.seed < 2**32):
        raise ValueError(f"seed must be an integer in [0, 2**32), or None, got {model.seed!r}.")
    if model.tensorboard_log is not None and not isinstance(model.tensorboard_log, str | os.PathLike):
        raise ValueError(f"tensorboard_log must be the path of a folder or None, got {model.tensorboard_log!r}.")
    if model.tensorboard_log is not None:
        check_folder("tensorboard_log", model.tensorboard_log)
    for name in ("policy_kwargs", "replay_buffer_kwargs"):
        check_dict(name, getattr(model, name))


def check_schedule_of_updates(model: SavedAlgorithm) -> None:
    """When updates happen, and how many.

    :param model: with its arguments, nothing built
    :raises ValueError: naming the argument, its value and what was expected
    """
    frequency, *unit = model.train_freq or (None,) if isinstance(model.train_freq, tuple) else (model.train_freq, "step")
    units = [getattr(one, "value", one) for one in unit]
    if not is_integer(frequency) or frequency < 1 or units not in (["step"], ["episode"]):
        raise ValueError(
            f'train_freq must be a positive integer, or one with its unit, as (1, "episode"), got {model.train_freq!r}.'
        )
    if not is_integer(model.gradient_steps) or model.gradient_steps < -1:
        raise ValueError(f"gradient_steps must be -1 or a non-negative integer, got {model.gradient_steps!r}.")


def check_noise(model: SavedAlgorithm) -> None:
    """
    :param model: with its arguments, nothing built
    :raises ValueError: for what is no noise of Stable-Baselines3's
    """
    if model.action_noise is not None and not isinstance(model.action_noise, ActionNoise):
        raise ValueError(f"action_noise must be an ActionNoise of Stable-Baselines3 or None, got {model.action_noise!r}.")


def check_number(name: str, value: Any, bounds: Range) -> None:
    """
    :param name: of the argument, for the message
    :param value: what was given
    :param bounds: where it must lie
    :raises ValueError: if it is no number, or lies elsewhere
    """
    low, low_ok, high, high_ok = bounds
    if not (is_number(value) and (low < value < high or (low_ok and value == low) or (high_ok and value == high))):
        interval = f"{'[' if low_ok else '('}{low:g}, {high:g}{']' if high_ok else ')'}"
        raise ValueError(f"{name} must lie in {interval}, got {value!r}.")


def check_rate(name: str, value: Any) -> None:
    """
    :param name: of the argument, for the message
    :param value: what was given
    :raises ValueError: for what is no learning rate, and for a schedule that does not begin with one
    """
    if not callable(value):
        if not _is_rate(value):
            raise ValueError(f"{name} must be a non-negative number or a schedule, got {value!r}.")
        return
    try:
        first = value(1.0)
    except Exception as error:
        raise ValueError(
            f"{name} must be a function of the share of the run that is left, 1 to 0: called with 1.0, it raises "
            f"{type(error).__name__}: {error}"
        ) from error
    check_scheduled_rate(name, first, 1.0)


def check_scheduled_rate(name: str, rate: Any, remaining: float) -> None:
    """
    :param name: of the argument, or of what learns by it, for the message
    :param rate: what the schedule gave
    :param remaining: for this share of the run
    :raises ValueError: if it is no learning rate
    """
    try:
        fits = _is_rate(float(rate))
    except (TypeError, ValueError):
        fits = False
    if not fits:
        raise ValueError(f"{name} must give non-negative numbers: with {remaining:.4g} of the run left it gives {rate!r}.")


def _is_rate(value: Any) -> bool:
    return is_finite_number(value) and value >= 0


def check_forms(precision: Any, compile: Any) -> None:
    """
    :param precision: of products
    :param compile: how updates run
    :raises ValueError: for unknown names
    """
    check_choice("precision", precision, PRECISIONS)
    check_choice("compile", compile, COMPILE)


def check_method(intrinsic_reward: Any, phase: str) -> None:
    """
    :param intrinsic_reward: what was given
    :param phase: of the model
    :raises ValueError: if the phase needs one and there is none
    """
    if intrinsic_reward is None and PHASES[phase].explores:
        raise ValueError(
            f"A model in the phase {phase!r} needs an intrinsic_reward, got None: to move on to the task, "
            "load it as it is and call fine_tune()."
        )


def check_kept(keep_actor: Any, keep_critic: Any, keep_reward: Any) -> None:
    """What a fine-tuning is told to take over.

    :param keep_actor: None lets the task decide
    :param keep_critic: see ``fine_tune``
    :param keep_reward: see ``fine_tune``
    :raises ValueError: for anything but True and False
    """
    if keep_actor is not None and not isinstance(keep_actor, bool):
        raise ValueError(f"keep_actor must be True, False or None, got {keep_actor!r}.")
    check_switch("keep_critic", keep_critic)
    check_switch("keep_reward", keep_reward)


def check_policy(model: SavedAlgorithm, base: type, filled_in: set[str]) -> None:
    """The policy's class and its arguments.

    :param model: with its arguments, nothing built
    :param base: class of the policies that the algorithm can train
    :param filled_in: arguments of the policy that the algorithm fills in itself
    :raises ValueError: for another class, or arguments that the policy has not
    """
    kind: Any = model.policy_class
    if not (isinstance(kind, type) and issubclass(kind, base)):
        raise ValueError(
            f"policy must be one of {sorted(model.policy_aliases)} or a subclass of {base.__name__}, got {kind!r}."
        )
    _check_names("policy_kwargs", model.policy_kwargs, kind, filled_in)


def check_replay(model: SavedAlgorithm, base: type[SequenceReplayBuffer], filled_in: set[str], reason: str) -> None:
    """The replay's class and its arguments.

    :param model: with its arguments, nothing built
    :param base: class of the replay that the algorithm draws from
    :param filled_in: arguments of the replay that the algorithm fills in itself, beside those of every replay
    :param reason: why no other replay will do
    :raises ValueError: for another class, or arguments that the replay has not
    """
    kind = base if model.replay_buffer_class is None else model.replay_buffer_class
    if not (isinstance(kind, type) and issubclass(kind, base)):
        raise ValueError(f"replay_buffer_class must be a subclass of {base.__name__}, got {kind!r}: {reason}.")
    _check_names("replay_buffer_kwargs", model.replay_buffer_kwargs, kind, REPLAY_ARGUMENTS_OF_THE_MODEL | filled_in)


def _check_names(name: str, given: dict[str, Any], kind: type, filled_in: set[str]) -> None:
    check_keys(name, given, set(named_parameters(kind)) - filled_in)


def check_pretrains(model: SavedAlgorithm) -> None:
    """Whether there is a pre-training to leave.

    :param model: that is to be fine-tuned
    :raises ValueError: if it never was pre-trained, or has left that behind
    """
    if PHASES[model.phase].explores:
        return
    me = type(model).__name__
    if model.arguments().get("intrinsic_reward") is None:
        raise ValueError(
            "fine_tune() needs a pre-trained model, and this one was never pre-trained: it was made without an "
            f"intrinsic_reward and learns its task at once. Go on with learn(), or make one that explores first: "
            f"{me}(..., intrinsic_reward=...)."
        )
    raise ValueError(
        f"fine_tune() needs a model in the phase {PRETRAINING!r}, this one is in {model.phase!r}: "
        "load the snapshot that was saved before the phases changed (SnapshotCallback), or go on with learn()."
    )


def check_load_keywords(algorithm: type[SavedAlgorithm], kwargs: dict[str, Any], method: str) -> None:
    """SB3 would silently set any keyword as an attribute.

    :param algorithm: whose
    :param kwargs: of the call
    :param method: that was called, ``load`` or ``resume``
    :raises UnknownNameError: for a keyword that is no constructor argument, or one that only makes sense there
    """
    me = algorithm.__name__
    for name, why in NOT_CHANGED.items():
        if name in kwargs:
            raise UnknownNameError(f"{me}.{method}: got an unexpected keyword argument {name!r}: {why.format(me=me)}.")
    known = [*algorithm.argument_names(), "device"]
    if unknown := [name for name in kwargs if name not in known]:
        raise unexpected_arguments(f"{me}.{method}", unknown, known, f"help({me})", algorithm.names_within())
