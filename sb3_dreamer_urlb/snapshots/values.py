"""Python values ↔ plain JSON. What is more than a number, a text, a list or a dictionary carries a tag from a fixed table.

Reading never looks a name up anywhere but in that table and in the registries of intrinsic rewards and planners.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.utils import ConstantSchedule, FloatSchedule, LinearSchedule

from sb3_dreamer_urlb.intrinsic import ExplorationMethod, get_intrinsic_reward, registered_intrinsic_rewards
from sb3_dreamer_urlb.number_checks import is_integer
from sb3_dreamer_urlb.planning import CategoricalDynaMPC, DynaMPC, Planner, PlannerConfig, registered_planners

TAG = "!"
CUSTOM = "custom"
#: tags of what a registry knows by its name
BY_NAME = ("intrinsic", "registered planner")
#: elements of an array or a space's bounds
MAX_ELEMENTS = 1 << 20


class Unstorable(TypeError):
    """A value of a kind that JSON and the tags cannot express."""


@dataclasses.dataclass(frozen=True)
class Custom:
    """Stands for a value that was not stored and must be given when loading.

    :param description: of what it was
    :param instance: whether it was an object of that class, with settings that the class alone does not tell
    """

    description: str
    instance: bool = False

    def __str__(self) -> str:
        return f"an object of the class {self.description}" if self.instance else self.description


def encode_or_describe(value: Any) -> Any:
    """As :func:`encode`, but what cannot be stored leaves a note of what it was."""
    try:
        return encode(value)
    except Unstorable:
        if isinstance(value, dict) and all(isinstance(key, str) and key != TAG for key in value):
            # Only what cannot be stored must be given again.
            return {key: encode_or_describe(item) for key, item in value.items()}
        instance = not (isinstance(value, type) or hasattr(value, "__qualname__"))
        described = type(value) if instance else value
        note = {TAG: CUSTOM, "description": f"{described.__module__}.{described.__qualname__}"}
        return {**note, "instance": True} if instance else note


def encode(value: Any) -> Any:
    """To JSON.

    :raises Unstorable: naming the value's type
    """
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        if math.isnan(value):
            raise Unstorable("NaN cannot be stored")
        return value if math.isfinite(value) else {TAG: "float", "value": str(value)}
    if isinstance(value, list | tuple):
        return [encode(item) for item in value]
    if isinstance(value, dict):
        if not all(isinstance(key, str) and key != TAG for key in value):
            raise Unstorable(f"A dictionary with the keys {list(value)} cannot be stored")
        return {key: encode(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return {TAG: "array", "dtype": value.dtype.name, "shape": list(value.shape), "values": encode(value.ravel().tolist())}
    if type(value) is VectorizedActionNoise:
        return encode(value.base_noise)  # learn() makes one for each environment again
    for kind, encoder in ENCODERS.items():
        # A space of the user's own class is, for everything that reads files, what it derives from.
        if type(value) is kind or (isinstance(value, spaces.Space) and isinstance(value, kind)):
            tag, fields = encoder(value)
            return {TAG: tag, **{name: encode(field) for name, field in fields.items()}}
    planner = isinstance(value, Planner) or (isinstance(value, type) and issubclass(value, Planner))
    return _encode_planner(value) if planner else _encode_intrinsic(value)


def decode(value: Any) -> Any:
    """From JSON; what was not stored becomes :class:`Custom`.

    :raises ValueError: for an unknown tag, or fields that do not fit it
    """
    if isinstance(value, list):
        return [decode(item) for item in value]
    if not isinstance(value, dict):
        return value
    fields = {name: decode(field) for name, field in value.items() if name != TAG}
    if TAG not in value:
        return fields
    tag = value[TAG]
    if not isinstance(tag, str) or tag not in DECODERS:
        raise ValueError(f"it holds a value of the unknown kind {tag!r}")
    try:
        return DECODERS[tag](**fields)
    except (TypeError, AttributeError, AssertionError, KeyError, OverflowError) as error:
        raise ValueError(f"it holds a {tag} that does not fit: {error}") from error


def contains_custom(value: Any) -> Custom | None:
    """The first :class:`Custom` anywhere inside ``value``."""
    if isinstance(value, Custom):
        return value
    children = value.values() if isinstance(value, dict) else value if isinstance(value, list) else ()
    return next((found for found in map(contains_custom, children) if found is not None), None)


def check_objects(stored: Mapping[str, Any], given: Mapping[str, Any]) -> None:
    """Whether objects that no file can hold are given as objects: their classes would build others, with other settings.

    :param stored: arguments of the file, as JSON
    :param given: those of the caller, which replace them
    :raises ValueError: for the class of what was an object
    """
    for name in stored.keys() & given.keys():
        note, kind = stored[name], given[name]
        # What is replaced need not be something that can be read here.
        if not (isinstance(note, dict) and note.get(TAG) == CUSTOM and note.get("instance") and isinstance(kind, type)):
            continue
        if (its := f"{kind.__module__}.{kind.__qualname__}") == note.get("description"):
            raise ValueError(
                f"its {name} was an object of the class {its}, with settings that no file can hold: give such an object, "
                "not the class"
            )


# -- intrinsic rewards -----------------------------------------------------------------------------------------------------


def _encode_intrinsic(value: Any) -> Any:
    """A registered class, or an instance that knows its keyword arguments, by the name it is registered under."""
    method = value if isinstance(value, type) else type(value)
    names = [name for name, known in registered_intrinsic_rewards(ExplorationMethod).items() if known is method]
    if not issubclass(method, ExplorationMethod) or not names:
        raise Unstorable(f"A {method.__module__}.{method.__qualname__} cannot be stored")
    if isinstance(value, type):
        return {TAG: "intrinsic", "name": names[0]}
    kwargs = getattr(value, "constructor_kwargs", None)
    if not isinstance(kwargs, dict):
        raise Unstorable(f"The {names[0]!r} does not tell its keyword arguments")
    return {TAG: "intrinsic", "name": names[0], "kwargs": encode(kwargs)}


def _intrinsic(name: str, kwargs: dict[str, Any] | None = None) -> Any:
    method = get_intrinsic_reward(name, ExplorationMethod)
    return method if kwargs is None else method(**kwargs)


# -- arrays and spaces -----------------------------------------------------------------------------------------------------


def _array(dtype: str, shape: list[int], values: list[Any]) -> np.ndarray:
    if np.dtype(dtype).kind not in "biuf":
        raise ValueError(f"it holds an array of {dtype}")
    return np.array(values, dtype).reshape(_shape(shape))


def _shape(shape: list[int]) -> tuple[int, ...]:
    if not all(type(size) is int and size >= 0 for size in shape) or math.prod(shape) > MAX_ELEMENTS:
        raise ValueError(f"it holds an array of the shape {shape}")
    return tuple(shape)


def _box_fields(space: spaces.Box) -> tuple[str, dict[str, Any]]:
    bounds = [bound.flat[0] if bound.size and (bound == bound.flat[0]).all() else bound for bound in (space.low, space.high)]
    return "Box", {"low": bounds[0], "high": bounds[1], "shape": space.shape, "dtype": np.dtype(space.dtype).name}


def _box(low: Any, high: Any, shape: list[int], dtype: str) -> spaces.Box:
    full = [np.broadcast_to(np.asarray(bound, dtype), _shape(shape)) for bound in (low, high)]
    return spaces.Box(full[0], full[1], tuple(shape), dtype=np.dtype(dtype).type)


def _discrete(n: int, start: int, dtype: str = "int64") -> spaces.Discrete:
    # Gymnasium had no other than int64 for a long time.
    return spaces.Discrete(n, start=start) if dtype == "int64" else spaces.Discrete(n, start=start, dtype=dtype)


def _multi_discrete(nvec: Any, start: Any = None, dtype: str = "int64") -> spaces.MultiDiscrete:
    return spaces.MultiDiscrete(nvec, dtype, start=start)


def _dict(parts: list[list[Any]]) -> spaces.Dict:
    if not all(isinstance(name, str) for name, _ in parts):
        raise ValueError("it holds a Dict with a name that is no text")
    return spaces.Dict([(name, space) for name, space in parts])


# -- planners --------------------------------------------------------------------------------------------------------------


def _planner_fields(planner: DynaMPC) -> tuple[str, dict[str, Any]]:
    return "planner", {"config": dataclasses.asdict(planner.config), "gae_lambda": planner.gae_lambda}


def _categorical_planner_fields(planner: CategoricalDynaMPC) -> tuple[str, dict[str, Any]]:
    return "categorical planner", {**_planner_fields(planner)[1], "classes": planner.classes}


def _categorical_planner(config: dict[str, Any], gae_lambda: float, classes: list[int]) -> CategoricalDynaMPC:
    if not classes or not all(is_integer(count) and count >= 1 for count in classes):
        raise ValueError(f"it holds a planner of the classes {str(classes)[:80]}")
    return CategoricalDynaMPC(PlannerConfig(**config), float(gae_lambda), classes)


def _encode_planner(value: Any) -> Any:
    """A class by the name it is registered under; an instance with its arguments, too, if it has those of every planner."""
    kind = value if isinstance(value, type) else type(value)
    places = [(name, kinds.index(kind)) for name, kinds in registered_planners().items() if kind in kinds]
    if not places:
        raise Unstorable(f"A {kind.__module__}.{kind.__qualname__} cannot be stored")
    named = {TAG: "registered planner", "name": places[0][0], "which": places[0][1]}
    if isinstance(value, type):
        return named
    if "__init__" in {name for base in kind.__mro__[: kind.__mro__.index(Planner)] for name in vars(base)}:
        raise Unstorable(f"The planner {places[0][0]!r} has a constructor of its own")
    fields = {"config": dataclasses.asdict(value.config), "gae_lambda": value.gae_lambda, "classes": value.classes}
    return {**named, "arguments": encode(fields)}


def _registered_planner(name: str, which: int, arguments: dict[str, Any] | None = None) -> Any:
    kinds = registered_planners().get(name)
    if kinds is None:
        raise ValueError(f"Unknown planner {name!r}; known are {sorted(registered_planners())}: register it before loading")
    if type(which) is not int or not 0 <= which < len(kinds):
        raise ValueError(f"it holds the planner {name!r} for actions that it does not plan")
    kind = kinds[which]
    if arguments is None:
        return kind
    config, classes = kind.config_class(**arguments["config"]), arguments["classes"]
    if not isinstance(classes, list) or not all(is_integer(count) and count >= 1 for count in classes):
        raise ValueError(f"it holds a planner of the classes {str(classes)[:80]}")
    return kind(config, float(arguments["gae_lambda"]), classes)


ENCODERS: dict[type, Callable[[Any], tuple[str, dict[str, Any]]]] = {
    spaces.Box: _box_fields,
    spaces.Discrete: lambda x: ("Discrete", {"n": x.n, "start": x.start, "dtype": np.dtype(x.dtype).name}),
    spaces.MultiBinary: lambda x: ("MultiBinary", {"n": x.n}),
    spaces.MultiDiscrete: lambda x: (
        "MultiDiscrete",
        {"nvec": x.nvec, "start": x.start, "dtype": np.dtype(x.dtype).name},
    ),
    # In its order, which the networks follow.
    spaces.Dict: lambda x: ("Dict", {"parts": list(x.spaces.items())}),
    FloatSchedule: lambda x: ("FloatSchedule", {"value_schedule": x.value_schedule}),
    ConstantSchedule: lambda x: ("ConstantSchedule", {"val": x.val}),
    LinearSchedule: lambda x: ("LinearSchedule", {"start": x.start, "end": x.end, "end_fraction": x.end_fraction}),
    NormalActionNoise: lambda x: ("NormalActionNoise", {"mean": x._mu, "sigma": x._sigma}),
    OrnsteinUhlenbeckActionNoise: lambda x: (
        "OrnsteinUhlenbeckActionNoise",
        {"mean": x._mu, "sigma": x._sigma, "theta": x._theta, "dt": x._dt, "initial_noise": x.initial_noise},
    ),
    DynaMPC: _planner_fields,
    CategoricalDynaMPC: _categorical_planner_fields,
}
DECODERS: dict[str, Callable[..., Any]] = {
    CUSTOM: lambda description, instance=False: Custom(str(description), instance is True),
    "float": lambda value: {"inf": math.inf, "-inf": -math.inf}[value],
    "array": _array,
    "intrinsic": _intrinsic,
    "planner": lambda config, gae_lambda: DynaMPC(PlannerConfig(**config), float(gae_lambda)),
    "categorical planner": _categorical_planner,
    "registered planner": _registered_planner,
    "Box": _box,
    "Discrete": _discrete,
    "MultiBinary": spaces.MultiBinary,
    "MultiDiscrete": _multi_discrete,
    "Dict": _dict,
    "FloatSchedule": FloatSchedule,
    "ConstantSchedule": lambda val: ConstantSchedule(float(val)),
    "LinearSchedule": lambda start, end, end_fraction: LinearSchedule(float(start), float(end), float(end_fraction)),
    "NormalActionNoise": NormalActionNoise,
    "OrnsteinUhlenbeckActionNoise": OrnsteinUhlenbeckActionNoise,
}
