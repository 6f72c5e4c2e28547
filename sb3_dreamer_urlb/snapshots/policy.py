"""A policy ↔ a file: constructor arguments and weights."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from typing import Any, TypeVar

import torch as th
from stable_baselines3.common.policies import BasePolicy

from sb3_dreamer_urlb.devices import chosen_device
from sb3_dreamer_urlb.nn.precision import suited
from sb3_dreamer_urlb.signatures import named_parameters
from sb3_dreamer_urlb.snapshots import tensors, values
from sb3_dreamer_urlb.snapshots.archive import TENSORS, Target, reading, writing

Policy = TypeVar("Policy", bound=BasePolicy)
KIND = "policy"
#: arguments that a policy without its algorithm has no use for
LEFT_OUT = {"self", "lr_schedule"}


def save(policy: BasePolicy, target: Target) -> None:
    """Write a policy; a path atomically and exactly as it is given.

    :param policy: what to save
    :param target: path or binary file object
    :raises ValueError: if a weight is not finite
    """
    parameters = _parameters(policy)
    content = tensors.pack(policy.state_dict())
    with writing(target, KIND, suffix="") as writer:
        writer.add(TENSORS, content)
        writer.finish({"parameters": {name: values.encode_or_describe(value) for name, value in parameters.items()}})


def _parameters(policy: BasePolicy) -> dict[str, Any]:
    """What a policy says that its constructor takes, and arguments of subclasses that they keep under the same name."""
    said = policy._get_constructor_parameters()
    own = {
        name: getattr(policy, name) for name in named_parameters(type(policy)) if name not in said and hasattr(policy, name)
    }
    return {name: value for name, value in {**said, **own}.items() if name not in LEFT_OUT}


def load(
    kind: type[Policy],
    source: Target,
    device: th.device | str,
    custom_objects: dict[str, Any] | None,
    others: Iterable[type[Any]] = (),
) -> Policy:
    """Read a policy.

    :param kind: its class
    :param source: path or binary file object
    :param device: where to put it
    :param custom_objects: constructor arguments that no file can hold
    :param others: classes whose policy it may be, if it is none of ``kind``
    :raises SnapshotError: naming the file and why it is refused
    """
    device = chosen_device(device)
    with reading(source, KIND) as archive:
        if set(archive.data) != {"parameters"}:
            raise ValueError("it has other fields than it should")
        parameters = {name: values.decode(value) for name, value in archive.data["parameters"].items()}
        _check_kind(kind, parameters, others)
        values.check_objects(archive.data["parameters"], custom_objects or {})
        if "precision" in parameters.keys() - (custom_objects or {}).keys():
            parameters["precision"] = suited(parameters["precision"], device)
        parameters.update(custom_objects or {})
        for name, value in parameters.items():
            if (missing := values.contains_custom(value)) is not None:
                raise ValueError(
                    f"its {name} was {missing}, which no file can hold; "
                    f"give it again: load(..., custom_objects={{{name!r}: ...}})"
                )
        found = tensors.read_table(archive, TENSORS)
        try:
            _compare(kind, parameters, found)
        except ValueError as error:
            its = next((other for other in others if _fits(other, parameters, found)), None)
            if its is None:
                raise
            raise ValueError(f"it is no {kind.__module__}.{kind.__qualname__}: it is one of {_reader(its)}") from error
        constructor: Any = kind
        policy: Policy = constructor(lr_schedule=_no_schedule, **parameters)
        policy.load_state_dict(tensors.unpack(archive, TENSORS))
        return policy.to(device)


def _check_kind(kind: type[Any], parameters: dict[str, Any], others: Iterable[type[Any]]) -> None:
    """
    :param kind: that was asked for
    :param parameters: of the file
    :param others: see :func:`load`
    :raises ValueError: if the policy is of another class
    """
    unknown = sorted(set(parameters) - set(named_parameters(kind)))
    if not unknown:
        return
    its = [other for other in others if set(parameters) <= set(named_parameters(other)) and _takes(other, parameters)]
    hint = f": it is one of {_reader(its[0])}" if its else ""
    raise ValueError(f"its policy has an argument {unknown[0]!r}, which {kind.__module__}.{kind.__qualname__} has not{hint}")


def _reader(kind: type[Any]) -> str:
    return f"{kind.__module__}.{kind.__qualname__}, whose load() reads it"


def _compare(kind: Any, parameters: dict[str, Any], found: Any) -> None:
    """:raises ValueError: if the policy cannot be made of these parameters, or has other weights"""
    tensors.compare(found, tensors.table_without_memory(lambda: kind(lr_schedule=_no_schedule, **parameters), found))


def _fits(kind: type[Any], parameters: dict[str, Any], found: Any) -> bool:
    if not set(parameters) <= set(named_parameters(kind)):
        return False
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            _compare(kind, parameters, found)
        except (ValueError, TypeError):
            return False
    return True


def _takes(kind: Any, parameters: dict[str, Any]) -> bool:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            kind.check_spaces(*(parameters[name] for name in ("observation_space", "action_space", "normalize_images")))
        except (ValueError, LookupError):
            return False
    return True


def _no_schedule(_: float) -> float:
    return 0.0
