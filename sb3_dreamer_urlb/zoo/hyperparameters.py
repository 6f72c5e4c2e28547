"""What a configuration says, before rl_zoo3 takes it apart: names that there are, classes, numbers."""

from __future__ import annotations

import ast
import importlib
import re
from collections.abc import Iterable, Iterator
from typing import Any

import gymnasium
import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

import sb3_dreamer_urlb
from sb3_dreamer_urlb.callbacks.checkpoint import RunCheckpointCallback
from sb3_dreamer_urlb.number_checks import check_integer
from sb3_dreamer_urlb.signatures import check_keywords, named_parameters
from sb3_dreamer_urlb.unknown_names import check_keys, did_you_mean

#: keys of a configuration that are rl_zoo3's or the zoo's here, no argument of the algorithm
OWN_KEYS = (
    *("callback", "env_kwargs", "env_wrapper", "frame_stack", "monitor_kwargs", "n_envs", "n_timesteps"),
    *("noise_std", "noise_type", "normalize", "vec_env_wrapper", "checkpoint", "pretrain_env", "resume"),
)
#: those of them that count something
WHOLE_NUMBERS = {"n_envs", "frame_stack"}
#: those that name classes, what these are given without being asked, and what they are
CLASSES: dict[str, tuple[tuple[str, ...], type]] = {
    "callback": ((), BaseCallback),
    "env_wrapper": (("env",), gymnasium.Env),
    "vec_env_wrapper": (("venv",), VecEnv),
}
#: arguments that rl_zoo3 hands over itself, from options of the same names
OF_THE_COMMAND_LINE = {"env", "seed", "device", "verbose", "tensorboard_log"}
#: keys whose values are nobody's to judge
OF_THE_ENVIRONMENT = "env_kwargs"
#: a number for everybody but YAML, which wants a point and a sign in it
EXPONENT = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+")


def check(hyperparams: dict[str, Any], algorithm: str, arguments: Iterable[str]) -> None:
    """
    :param hyperparams: of a configuration and the command line, as they are written
    :param algorithm: as ``--algo`` knows it
    :param arguments: of its constructor
    :raises ValueError: naming the key, what stands there and what was expected
    """
    known = {*arguments, *OWN_KEYS}
    if unknown := [name for name in hyperparams if name not in known]:
        which = f"hyperparameter{'s' * (len(unknown) > 1)} {', '.join(map(repr, unknown))}"
        raise ValueError(f"Unknown {which}, neither of rl_zoo3's nor of {algorithm}'s.{did_you_mean(unknown, known)}")
    if misplaced := sorted(OF_THE_COMMAND_LINE & set(hyperparams)):
        verb = "are no hyperparameters" if len(misplaced) > 1 else "is no hyperparameter"
        options = ", ".join(f"--{name.replace('_', '-')}" for name in misplaced)
        raise ValueError(f"{', '.join(misplaced)} {verb}: give {options} on the command line.")
    if not isinstance(kwargs := hyperparams.get(OF_THE_ENVIRONMENT) or {}, dict | str):
        raise ValueError(f"{OF_THE_ENVIRONMENT} must be arguments of the environment by name, got {kwargs!r}.")
    if hyperparams.get("noise_type") is not None and "noise_std" not in hyperparams:
        raise ValueError(f"noise_type {hyperparams['noise_type']!r} needs noise_std, the noise's standard deviation.")
    for path, text in _texts({name: value for name, value in hyperparams.items() if name != OF_THE_ENVIRONMENT}):
        if EXPONENT.fullmatch(text):
            raise ValueError(f"{path}: YAML reads {text} as text, not as a number: write {_for_yaml(text)}.")
    check_steps("n_timesteps", hyperparams.get("n_timesteps", 1))
    for name in WHOLE_NUMBERS & set(hyperparams):
        check_integer(name, hyperparams[name], 1)
    for key in CLASSES:
        _check_classes(key, hyperparams.get(key))
    _check_normalize(hyperparams.get("normalize"))
    policy = hyperparams.get("policy", "")
    if not isinstance(policy, str | type):
        raise ValueError(f"policy must be the name of one, as CnnPolicy, got {policy!r}.")
    if isinstance(policy, str) and "." in policy:
        _find_class("policy", policy)
    checkpoint = hyperparams.get("checkpoint")
    if isinstance(checkpoint, dict):
        # The run's folder and its evaluation are rl_zoo3's.
        check_keys("checkpoint", checkpoint, named_parameters(RunCheckpointCallback).keys() - {"folder", "evaluation"})


def check_evaluated(normalize: Any, monitor_kwargs: Any) -> None:
    """What rl_zoo3 may have made of texts.

    :param normalize: keyword arguments of VecNormalize
    :param monitor_kwargs: of Monitor
    :raises ValueError: for names that they do not have
    """
    for key, given, kind, filled_in in (
        ("normalize", normalize, VecNormalize, {"venv"}),
        ("monitor_kwargs", monitor_kwargs, Monitor, {"env", "filename"}),
    ):
        if not isinstance(given, dict):
            raise ValueError(f"{key} must be keyword arguments of {kind.__name__}, got {given!r}.")
        check_keys(key, given, named_parameters(kind).keys() - filled_in)
    names = monitor_kwargs.get("info_keywords", ())
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"monitor_kwargs: info_keywords must be a list of names, got {names!r}.")


def _check_normalize(normalize: Any) -> None:
    """rl_zoo3 puts gamma into what it has read, and finds out there that it is no dictionary."""
    if not isinstance(normalize, str):
        return
    try:
        read = ast.literal_eval(normalize)
    except (SyntaxError, ValueError):
        return  # for Python to say, which evaluates more than literals
    if not isinstance(read, dict):
        raise ValueError(
            f"normalize must be true, false, or keyword arguments of VecNormalize as a text, got the text {normalize!r}."
        )


def check_steps(name: str, steps: Any) -> None:
    """
    :param name: of what says how long a run is
    :param steps: what it says
    :raises ValueError: if that is no number of steps
    """
    try:
        positive = int(steps) >= 1
    except (TypeError, ValueError, OverflowError):
        positive = False
    if not positive:
        raise ValueError(f"{name} must be a positive number of agent steps, got {steps!r}.")


def _texts(value: Any, path: str = "") -> Iterator[tuple[str, str]]:
    """All texts inside of nested lists and dictionaries, and where they stand."""
    if isinstance(value, str):
        yield path, value
    elif isinstance(value, dict):
        for name, inner in value.items():
            yield from _texts(inner, f"{path}: {name}" if path else str(name))
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from _texts(inner, path)


def _for_yaml(text: str) -> str:
    number = float(text)
    if number.is_integer() and abs(number) < 1e15:
        return str(int(number))
    return np.format_float_scientific(number, trim="0", exp_digits=1)


def _check_classes(key: str, entries: Any) -> None:
    filled_in, base = CLASSES[key]
    for entry in entries if isinstance(entries, list) else [] if entries is None else [entries]:
        name: Any = entry
        kwargs: Any = {}
        if isinstance(entry, dict):
            if len(entry) != 1:
                raise ValueError(
                    f"{key}: expected a class and its arguments, indented below it, got {len(entry)} side by side: "
                    f"{', '.join(map(str, entry))}."
                )
            [(name, kwargs)] = entry.items()
        if isinstance(name, str):
            name = _find_class(key, name)
        elif not callable(name):
            raise ValueError(f"{key}: expected module.Class, got {name!r}.")
        if not isinstance(kwargs, dict):
            raise ValueError(f"{key}: expected arguments of {getattr(name, '__name__', name)} by name, got {kwargs!r}.")
        if isinstance(name, type):
            # A function may make whatever it likes.
            if not issubclass(name, base):
                raise ValueError(f"{key}: expected a subclass of {base.__name__}, got {name.__module__}.{name.__name__}.")
            check_keywords(name, kwargs, filled_in)


def _find_class(key: str, path: str) -> Any:
    """What rl_zoo3 will import.

    :raises ValueError: if there is none of this name
    :raises ImportError: if its module cannot be imported
    """
    module, _, name = path.rpartition(".")
    ours = [f"{sb3_dreamer_urlb.__name__}.{near}" for near in sb3_dreamer_urlb.__all__]
    if not module:
        raise ValueError(f"{key}: expected module.Class, got {path!r}.{did_you_mean([path], ours)}")
    try:
        found = importlib.import_module(module)
    except ImportError as error:
        raise ImportError(f"{key}: {path} cannot be imported: {error}.{did_you_mean([path], ours)}") from error
    try:
        return getattr(found, name)
    except AttributeError:
        raise ValueError(f"{key}: {module} has no {name!r}.{did_you_mean([name], dir(found))}") from None
