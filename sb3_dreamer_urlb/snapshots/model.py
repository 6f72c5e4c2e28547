"""DreamerV2 ↔ a file: constructor arguments, counters, random states, weights and the optimisers' moments.

Not in the file: the replay (``save_replay_buffer``, or a run folder), the environment, and the episode that is open.
"""

from __future__ import annotations

import inspect
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import torch as th
from stable_baselines3.common.base_class import maybe_make_env
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import check_for_correct_spaces, get_system_info
from stable_baselines3.common.vec_env import unwrap_vec_normalize

from sb3_dreamer_urlb import phases
from sb3_dreamer_urlb.number_checks import is_finite_number, is_integer
from sb3_dreamer_urlb.snapshots import tensors, values
from sb3_dreamer_urlb.snapshots.archive import TENSORS, Archive, Target, reading, writing
from sb3_dreamer_urlb.snapshots.random_state import RandomStates, capture

if TYPE_CHECKING:
    from sb3_dreamer_urlb.dreamer_v2 import DreamerV2

Model = TypeVar("Model", bound="DreamerV2")

KIND = "model"
#: constructor arguments that are the loader's business
NOT_STORED = {"self", "policy", "env", "device", "_init_setup_model"}
#: arguments whose attribute SB3 calls otherwise
ATTRIBUTES = {"stats_window_size": "_stats_window_size"}
COUNTERS = (
    "num_timesteps", "_total_timesteps", "_episode_num", "_n_updates",
    "phase_timesteps", "phase_updates", "phase_frames", "action_repeat",
)  # fmt: skip
FIELDS = {
    "policy", "arguments", "observation_space", "action_space", "n_envs", "phase", "domain", "counters",
    "progress_remaining", "random", "episodes", "run",
}  # fmt: skip
MAX_ENVS = 65_536
#: whose statistics are kept
MAX_EPISODES = 1000
MOMENTS = ("exp_avg", "exp_avg_sq")


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


# -- saving ----------------------------------------------------------------------------------------------------------------


def save(model: DreamerV2, target: Target, run: dict[str, Any] | None = None) -> None:
    """Write a model; a path atomically.

    :param model: what to save
    :param target: path (``.zip`` is added where it has no suffix), or binary file object
    :param run: what a run folder adds, JSON
    :raises ValueError: if a weight is not finite; the old file stays
    :raises OSError: naming the path; the old file stays
    """
    content = tensors.pack(_all_tensors(model))
    with writing(target, KIND) as writer:
        writer.add(TENSORS, content)
        writer.finish(_data(model, run))


def _data(model: DreamerV2, run: dict[str, Any] | None) -> dict[str, Any]:
    arguments = {name: getattr(model, ATTRIBUTES.get(name, name)) for name in argument_names(type(model))}
    arguments["train_freq"] = (model.train_freq.frequency, model.train_freq.unit.value)  # type: ignore[union-attr]
    aliases = [alias for alias, known in model.policy_aliases.items() if known is model.policy_class]
    return {
        "policy": aliases[0] if aliases else values.encode_or_describe(model.policy_class),
        "arguments": {name: values.encode_or_describe(value) for name, value in arguments.items()},
        "observation_space": values.encode(model.observation_space),
        "action_space": values.encode(model.action_space),
        "n_envs": model.n_envs,
        "phase": model.phase,
        "domain": values.encode(model.domain),
        "counters": {name.lstrip("_"): values.encode(getattr(model, name)) for name in COUNTERS},
        "progress_remaining": float(model._current_progress_remaining),
        "random": capture(model),
        "episodes": [
            {key: float(info[key]) for key in ("r", "l", "t")}
            for info in list(model.ep_info_buffer or ())[-MAX_EPISODES:]
            if all(is_finite_number(info.get(key)) for key in ("r", "l", "t"))
        ],
        "run": run,
    }


def argument_names(algorithm: type[DreamerV2]) -> list[str]:
    """The constructor arguments that files hold."""
    return [name for name in inspect.signature(algorithm.__init__).parameters if name not in NOT_STORED]


def _all_tensors(model: DreamerV2) -> dict[str, th.Tensor]:
    found = _named(model.policy)
    for name, optimizer in model.learner.optimizers().items():
        for i, parameter in enumerate(optimizer.parameters):
            for key, value in optimizer.adam.state.get(parameter, {}).items():
                found[f"{name}.{i}.{key}"] = value
    return found


def _named(policy: th.nn.Module) -> dict[str, th.Tensor]:
    return {f"policy.{name}": value for name, value in policy.state_dict().items()}


# -- loading ---------------------------------------------------------------------------------------------------------------


def load(
    algorithm: type[Model],
    source: Target,
    env: GymEnv | str | None,
    device: th.device | str,
    custom_objects: dict[str, Any] | None,
    print_system_info: bool,
    kwargs: dict[str, Any],
    resume: bool = False,
) -> tuple[Model, dict[str, Any] | None]:
    """Read a model.

    :param algorithm: class of the model
    :param source: path or binary file object
    :param env: environment to go on in
    :param device: where to put the networks
    :param custom_objects: replaces arguments; names that are none are ignored, as SB3 does
    :param print_system_info: print those of the file and of this machine
    :param kwargs: replaces arguments, too
    :param resume: restore the random states of an unseeded model, too
    :return: the model, and what a run folder added
    :raises SnapshotError: naming the file and why it is refused
    """
    with reading(source, KIND) as archive:
        if print_system_info:
            print("== CURRENT SYSTEM INFO ==")
            get_system_info()
            print("== SAVED MODEL SYSTEM INFO ==")
            print(archive.system_info)
        data = archive.data
        if set(data) != FIELDS:
            raise ValueError(f"it has other fields than it should: {sorted(set(data) ^ FIELDS)}")
        model = _blank(algorithm, data, device, custom_objects or {}, kwargs)
        _restore_fields(model, data)
        states = None if data["random"] is None else RandomStates(data["random"])
        if env is not None:
            _attach(model, env)
        model._prepare()
        _build_checked(model, archive)
        _put(model, tensors.unpack(archive, TENSORS))
        # Runs that start from one unseeded model are meant to differ.
        if states is not None and (resume or model.seed is not None) and "seed" not in kwargs:
            states.apply(model)
        return model, data["run"]


def _blank(
    algorithm: type[Model], data: dict[str, Any], device: th.device | str, custom: dict[str, Any], kwargs: dict[str, Any]
) -> Model:
    """A model with the stored arguments and without networks."""
    known = argument_names(algorithm)
    arguments = dict(data["arguments"])
    unknown = sorted(set(arguments) - set(known))
    if unknown:
        raise ValueError(f"it has an argument {unknown[0]!r}, which {algorithm.__name__} has not")
    given = {**{name: value for name, value in custom.items() if name in known and name != "preset"}, **kwargs}
    decoded = {name: values.decode(value) for name, value in arguments.items() if name not in given}
    for name, value in decoded.items():
        if (missing := values.contains_custom(value)) is not None:
            raise ValueError(
                f"its {name} was {missing.description}, which no file can hold; "
                f"give it again: load(..., custom_objects={{{name!r}: ...}})"
            )
        if name in CHECKS and not CHECKS[name](value):
            raise ValueError(f"its {name} is {str(value)[:80]!r}")
    if isinstance(decoded.get("train_freq"), list):
        decoded["train_freq"] = tuple(decoded["train_freq"])
    policy = custom.get("policy", custom.get("policy_class", data["policy"]))
    if not isinstance(policy, str | type):
        raise ValueError(
            f"its policy was {values.decode(policy)}, which no file can hold; give it again: "
            "load(..., custom_objects={'policy': ...})"
        )
    # The stored arguments are complete: the preset must not fill anything in.
    preset = decoded.pop("preset", "paper")
    model = algorithm(policy, None, device=device, preset="paper", _init_setup_model=False, **{**decoded, **given})
    model.preset = preset
    return model


def _restore_fields(model: DreamerV2, data: dict[str, Any]) -> None:
    model.observation_space = values.decode(data["observation_space"])
    model.action_space = values.decode(data["action_space"])
    for name in COUNTERS:
        value = data["counters"][name.lstrip("_")]
        if type(value) is not int or not 0 <= value < 2**62:
            raise ValueError(f"its counter {name.lstrip('_')} is {str(value)[:80]!r}")
        setattr(model, name, value)
    if not isinstance(data["phase"], str) or data["phase"] not in phases.PHASES:
        raise ValueError(f"its phase is {str(data['phase'])[:80]!r}; known are {sorted(phases.PHASES)}")
    if not (data["domain"] is None or isinstance(data["domain"], str)):
        raise ValueError("its domain is no text")
    if type(data["n_envs"]) is not int or not 1 <= data["n_envs"] <= MAX_ENVS:
        raise ValueError(f"its n_envs is {str(data['n_envs'])[:80]}")
    if not is_finite_number(data["progress_remaining"]):
        raise ValueError("its progress_remaining is no number")
    model.phase, model.domain, model.n_envs = data["phase"], data["domain"], data["n_envs"]
    model._current_progress_remaining = float(data["progress_remaining"])
    episodes = data["episodes"]
    if not all(set(info) == {"r", "l", "t"} and all(is_finite_number(value) for value in info.values()) for info in episodes):
        raise ValueError("its statistics of episodes are damaged")
    model.ep_info_buffer = deque(episodes, maxlen=model._stats_window_size)
    model.ep_success_buffer = deque(maxlen=model._stats_window_size)


def _attach(model: DreamerV2, env: GymEnv | str) -> None:
    wrapped = model._wrap_env(maybe_make_env(env, model.verbose), model.verbose)
    check_for_correct_spaces(wrapped, model.observation_space, model.action_space)
    model.env, model.n_envs = wrapped, wrapped.num_envs
    model._vec_normalize_env = unwrap_vec_normalize(wrapped)


def _build_checked(model: DreamerV2, archive: Archive) -> None:
    """Build the networks only after the file's tensors turned out to be of just their sizes."""
    found = tensors.read_table(archive, TENSORS)
    expected = {f"policy.{name}": entry for name, entry in tensors.table_without_memory(model._new_policy, found).items()}
    tensors.compare({name: entry for name, entry in found.items() if name.startswith("policy.")}, expected)
    model.set_random_seed(model.seed)
    model._build()
    tensors.compare(found, _with_moments(model, expected, found))


def _with_moments(model: DreamerV2, weights: tensors.Table, found: tensors.Table) -> tensors.Table:
    """The table of a file with these weights; an optimiser has moments from its first update on."""
    expected = dict(weights)
    for name, optimizer in model.learner.optimizers().items():
        if not any(key.startswith(f"{name}.") for key in found):
            continue
        for i, parameter in enumerate(optimizer.parameters):
            expected[f"{name}.{i}.step"] = ("F32", ())
            expected |= {f"{name}.{i}.{key}": (tensors.DTYPES[parameter.dtype], tuple(parameter.shape)) for key in MOMENTS}
    return expected


def _put(model: DreamerV2, loaded: dict[str, th.Tensor]) -> None:
    """Copy tensors of a checked table into the model."""
    for name, value in loaded.items():
        if name.endswith((".step", ".exp_avg_sq")) and not name.startswith("policy.") and bool((value < 0).any()):
            raise ValueError(f"the tensor {name!r} holds negative values")
    model.policy.load_state_dict({name.removeprefix("policy."): v for name, v in loaded.items() if name.startswith("policy.")})
    for name, optimizer in model.learner.optimizers().items():
        state = {
            i: {key: loaded[f"{name}.{i}.{key}"] for key in ("step", *MOMENTS)}
            for i in range(len(optimizer.parameters))
            if f"{name}.{i}.step" in loaded
        }
        # The settings stay the arguments'.
        optimizer.adam.load_state_dict({"state": state, "param_groups": optimizer.adam.state_dict()["param_groups"]})


def set_parameters(model: DreamerV2, source: Target, exact_match: bool) -> None:
    """Take weights and moments over from a file.

    :param model: changed in place; as a whole, or not at all
    :param source: path or binary file object
    :param exact_match: False takes only the weights that both have
    :raises SnapshotError: naming the file and why it is refused
    """
    with reading(source, KIND) as archive:
        own = tensors.table_of(_named(model.policy))
        found = tensors.read_table(archive, TENSORS)
        if exact_match:
            tensors.compare(found, _with_moments(model, own, found))
            _put(model, tensors.unpack(archive, TENSORS))
            return
        common = own.keys() & found.keys()
        tensors.compare({name: found[name] for name in common}, {name: own[name] for name in common})
        loaded = tensors.unpack(archive, TENSORS)
        model.policy.load_state_dict({name.removeprefix("policy."): loaded[name] for name in common}, strict=False)
