"""The JSON of a model's file ↔ the model: constructor arguments, counters, phase, random states, statistics of episodes."""

from __future__ import annotations

import re
import warnings
from collections import deque
from collections.abc import Callable
from typing import Any, TypeVar

import torch as th
from stable_baselines3.common.utils import get_device

from sb3_dreamer_urlb import phases
from sb3_dreamer_urlb.folders import check_folder
from sb3_dreamer_urlb.nn.precision import suited
from sb3_dreamer_urlb.number_checks import is_finite_number, is_integer, plain
from sb3_dreamer_urlb.planning import Planner
from sb3_dreamer_urlb.signatures import constructed, named_parameters
from sb3_dreamer_urlb.snapshots import values
from sb3_dreamer_urlb.snapshots.random_state import capture
from sb3_dreamer_urlb.snapshots.registered import check_registered, or_another
from sb3_dreamer_urlb.snapshots.saved_algorithm import ATTRIBUTES, SavedAlgorithm, public_algorithms, without_networks

Model = TypeVar("Model", bound=SavedAlgorithm)

COUNTERS = (
    "num_timesteps", "_total_timesteps", "_episode_num", "_n_updates",
    "phase_timesteps", "phase_updates", "phase_frames", "pretrained_frames", "action_repeat", "env_faults", "skipped_updates",
)  # fmt: skip
FIELDS = {
    "policy", "arguments", "observation_space", "action_space", "n_envs", "phase", "domain", "learnt_task", "counters",
    "progress_remaining", "random", "episodes", "run", "kept",
}  # fmt: skip
#: what a fine-tuning may begin with, beside the world model
KEPT = {"actor", "critic", "reward"}
#: arguments that every constructor of an algorithm takes in front
FIRST = ("policy", "env")
MAX_ENVS = 65_536
#: whose statistics are kept
MAX_EPISODES = 1000


def _is_dict_or_none(value: Any) -> bool:
    return value is None or isinstance(value, dict)


#: arguments that nobody else checks
CHECKS: dict[str, Callable[[Any], bool]] = {
    "verbose": lambda value: is_integer(value) and 0 <= value <= 2,
    "stats_window_size": lambda value: is_integer(value) and 1 <= value <= 1_000_000,
    "seed": lambda value: value is None or (is_integer(value) and 0 <= value < 2**32),
    "tensorboard_log": lambda value: value is None or isinstance(value, str),
    "preset": lambda value: isinstance(value, str),
    "discount_head": lambda value: value is None or isinstance(value, bool),
    "policy_kwargs": _is_dict_or_none,
    "intrinsic_kwargs": _is_dict_or_none,
    "planner_kwargs": _is_dict_or_none,
    "replay_buffer_kwargs": _is_dict_or_none,
}


def describe(model: SavedAlgorithm, run: dict[str, Any] | None) -> dict[str, Any]:
    """All of a model but its tensors, as JSON.

    :param model: what to describe
    :param run: what a run folder adds, JSON
    """
    aliases = [alias for alias, known in model.policy_aliases.items() if known is model.policy_class]
    return {
        "policy": aliases[0] if aliases else values.encode_or_describe(model.policy_class),
        "arguments": describe_arguments(model),
        "observation_space": values.encode(model.observation_space),
        "action_space": values.encode(model.action_space),
        "n_envs": model.n_envs,
        "phase": model.phase,
        "domain": values.encode(model.domain),
        "learnt_task": model.learnt_task,
        "counters": {name.lstrip("_"): values.encode(getattr(model, name)) for name in COUNTERS},
        "progress_remaining": float(model._current_progress_remaining),
        "random": capture(model),
        "episodes": [
            {key: float(info[key]) for key in ("r", "l", "t")}
            for info in list(model.ep_info_buffer or ())[-MAX_EPISODES:]
            if all(is_finite_number(info.get(key)) for key in ("r", "l", "t"))
        ],
        "run": run,
        "kept": model.kept,
    }


def describe_arguments(model: SavedAlgorithm) -> dict[str, Any]:
    """The constructor arguments of a model, as JSON."""
    arguments = model.arguments()
    for name in sorted(set(model.argument_names()) - set(arguments)):
        what = f"{type(model).__name__} has no attribute {name!r}"
        warnings.warn(f"{what}: its file leaves that argument out. To keep it: self.{name} = {name}.")
    arguments["train_freq"] = (model.train_freq.frequency, model.train_freq.unit.value)  # type: ignore[union-attr]
    return {name: values.encode_or_describe(value) for name, value in arguments.items()}


def _folder_of_logs(path: str | None) -> str | None:
    """Where the file's model logs; None, with a warning, where that can be no folder on this machine."""
    try:
        if path is not None:
            check_folder("tensorboard_log", path)
    except NotADirectoryError as error:
        warnings.warn(f"The model will log nowhere, unless you give another folder, load(..., tensorboard_log=...): {error}")
        return None
    return path


def blank(
    algorithm: type[Model], data: dict[str, Any], device: th.device | str, custom: dict[str, Any], kwargs: dict[str, Any]
) -> Model:
    """A model with the stored arguments and without networks.

    :param algorithm: its class
    :param data: of the file
    :param device: where its networks will be
    :param custom: replaces arguments; names that are none are ignored
    :param kwargs: replaces arguments, too
    :raises ValueError: for arguments that are damaged, or that no file can hold and nobody gave
    """
    known = algorithm.argument_names()
    arguments = dict(data["arguments"])
    check_whose(algorithm, data)
    given = {**{name: value for name, value in custom.items() if name in known and name != "preset"}, **kwargs}
    _check_method(arguments, given)
    if isinstance(given.get("planner"), Planner):
        given.setdefault("planner_kwargs", None)  # those stored belong to the one that it replaces
    check_registered(arguments, given)
    values.check_objects(arguments, given)
    # A stored value that is replaced need not be one that can be read here.
    decoded = {
        name: values.decode(value) for name, value in arguments.items() if name not in given or name.endswith("_kwargs")
    }
    given = {name: _extended(name, decoded.get(name), value) for name, value in given.items()}
    decoded |= given
    for name, value in decoded.items():
        if (missing := values.contains_custom(value)) is not None:
            raise ValueError(
                f"its {name} was {missing}, which no file can hold; "
                f"give it again: load(..., custom_objects={{{name!r}: ...}}){or_another(name)}"
            )
        if name in CHECKS and name not in given and not CHECKS[name](value):
            raise ValueError(f"its {name} is {str(value)[:80]!r}")
    if "tensorboard_log" not in given:
        decoded["tensorboard_log"] = _folder_of_logs(decoded.get("tensorboard_log"))
    if "precision" not in given and "precision" in decoded:
        decoded["precision"] = suited(decoded["precision"], get_device(device))
    if isinstance(decoded.get("train_freq"), list):
        decoded["train_freq"] = tuple(decoded["train_freq"])
    policy = custom.get("policy", custom.get("policy_class", data["policy"]))
    if not isinstance(policy, str | type) and policy is not data["policy"]:
        raise ValueError(f"policy must be one of {sorted(algorithm.policy_aliases)} or a class, got {policy!r}.")
    if not isinstance(policy, str | type):
        raise ValueError(
            f"its policy was {values.decode(policy)}, which no file can hold; give it again: "
            "load(..., custom_objects={'policy': ...})"
        )
    # The stored arguments are complete: the preset must not fill anything in.
    preset = decoded.pop("preset", "paper")
    given_by_us = {"policy": policy, "env": None, "device": get_device(device), "_init_setup_model": False}
    model = _constructed(algorithm, {**given_by_us, "preset": "paper", **decoded})
    model.preset = preset
    return model


def check_whose(algorithm: type[SavedAlgorithm], data: dict[str, Any]) -> None:
    """Whether a class can have saved a file.

    :param algorithm: the class
    :param data: of the file
    :raises ValueError: if it is another algorithm's, or a subclass's with arguments of its own
    """
    stored, me = set(data["arguments"]), algorithm.__name__
    unknown = sorted(stored - set(algorithm.argument_names()))
    if not unknown:
        return
    # What has all of this class's arguments is no other algorithm's: none is imported for a message about a damaged file.
    others = [] if stored.issuperset(algorithm.argument_names()) else public_algorithms()
    its = next((kind.__name__ for kind in others if stored <= set(kind.argument_names())), None)
    if its is not None:
        raise ValueError(f"it holds a model of {its}, not of {me}: {its}.load reads it")
    raise ValueError(f"it has an argument {unknown[0]!r}, which {me} has not: the load of the class that saved it reads it")


def _extended(name: str, stored: Any, given: Any) -> Any:
    """What a caller's argument makes of the stored one: dictionaries extend, as a preset's; else it replaces.

    :param name: of the argument
    :param stored: of the file
    :param given: the caller's
    """
    if name.endswith("_kwargs") and isinstance(stored, dict) and isinstance(given, dict):
        return {**stored, **given}
    return given


def _constructed(algorithm: type[Model], arguments: dict[str, Any]) -> Model:
    """Without networks. What a subclass decides itself, and does not let itself be told, it is told afterwards.

    :param algorithm: the class
    :param arguments: of all that the class extends, by name
    :raises ValueError: if a subclass cannot be made so
    """
    told = {name: value for name, value in arguments.items() if name in named_parameters(algorithm)}
    while True:
        first = {name: told[name] for name in FIRST if name in told}
        others = {name: value for name, value in told.items() if name not in first}
        try:
            with without_networks():
                model: Model = constructed(algorithm, first, **others)
            break
        except (TypeError, AttributeError) as error:
            twice = re.search(r"multiple values for (?:keyword )?argument '(\w+)'", str(error))
            if twice is None or twice[1] not in told:
                raise ValueError(
                    f"{algorithm.__name__} cannot be made as files are read, with env=None and those of its arguments that "
                    f"the model keeps as attributes of the same names: {error}"
                ) from error
            del told[twice[1]]
    for name in arguments.keys() - told.keys() - {"policy", "env", "_init_setup_model"}:
        attribute, value = ATTRIBUTES.get(name, name), plain(arguments[name])
        # Stable-Baselines3's constructors make dictionaries of None.
        empty = value is None and isinstance(getattr(model, attribute, None), dict)
        setattr(model, attribute, {} if empty else value)
    return model


def _check_method(stored: dict[str, Any], given: dict[str, Any]) -> None:
    """A model is what it learnt with; of a class, only the networks can tell."""
    was, wanted = values.decode(stored.get("intrinsic_reward")), given.get("intrinsic_reward")
    if "intrinsic_reward" in given and all(one is None or isinstance(one, str) for one in (was, wanted)) and was != wanted:
        raise ValueError(f"intrinsic_reward must be {was!r}, with which the model was trained, got {wanted!r}.")


def needed(data: dict[str, Any]) -> list[str]:
    """The names of what no file can hold: the caller must give it."""
    stored = {"policy": data["policy"], **data["arguments"]}
    names = [name for name, value in stored.items() if values.contains_custom(values.decode(value)) is not None]
    return names + ["policy_class"] * ("policy" in names)


def restore_fields(model: SavedAlgorithm, data: dict[str, Any]) -> None:
    """Everything that is neither argument nor tensor.

    :param model: blank
    :param data: of the file
    :raises ValueError: for fields of wrong types or ranges
    """
    model.observation_space = values.decode(data["observation_space"])
    model.action_space = values.decode(data["action_space"])
    for name in COUNTERS:
        value = data["counters"][name.lstrip("_")]
        if type(value) is not int or not 0 <= value < 2**62:
            raise ValueError(f"its counter {name.lstrip('_')} is {str(value)[:80]!r}")
        setattr(model, name, value)
    if not isinstance(data["phase"], str) or data["phase"] not in phases.PHASES:
        raise ValueError(f"its phase is {str(data['phase'])[:80]!r}; known are {sorted(phases.PHASES)}")
    for name in ("domain", "learnt_task"):
        if not (data[name] is None or isinstance(data[name], str)):
            raise ValueError(f"its {name} is no text")
    kept = data["kept"]
    known = isinstance(kept, dict) and set(kept) == KEPT and all(type(one) is bool for one in kept.values())
    if not (kept is None or known):
        raise ValueError(f"what its fine-tuning kept is {str(kept)[:80]}")
    model.kept = kept
    if type(data["n_envs"]) is not int or not 1 <= data["n_envs"] <= MAX_ENVS:
        raise ValueError(f"its n_envs is {str(data['n_envs'])[:80]}")
    if not is_finite_number(data["progress_remaining"]):
        raise ValueError("its progress_remaining is no number")
    model.phase, model.domain, model.n_envs = data["phase"], data["domain"], data["n_envs"]
    model.learnt_task = data["learnt_task"]
    model._current_progress_remaining = float(data["progress_remaining"])
    episodes = data["episodes"]
    if not all(set(info) == {"r", "l", "t"} and all(is_finite_number(value) for value in info.values()) for info in episodes):
        raise ValueError("its statistics of episodes are damaged")
    model.ep_info_buffer = deque(episodes, maxlen=model._stats_window_size)
    model.ep_success_buffer = deque(maxlen=model._stats_window_size)
