"""A policy ↔ a file: constructor arguments and weights."""

from __future__ import annotations

from typing import Any, TypeVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.utils import get_device

from sb3_dreamer_urlb.snapshots import tensors, values
from sb3_dreamer_urlb.snapshots.archive import TENSORS, Target, reading, writing

Policy = TypeVar("Policy", bound=BasePolicy)
KIND = "policy"


def save(policy: BasePolicy, target: Target) -> None:
    """Write a policy; a path atomically and exactly as it is given.

    :param policy: what to save
    :param target: path or binary file object
    :raises ValueError: if a weight is not finite
    """
    parameters = {name: value for name, value in policy._get_constructor_parameters().items() if name != "lr_schedule"}
    content = tensors.pack(policy.state_dict())
    with writing(target, KIND, suffix="") as writer:
        writer.add(TENSORS, content)
        writer.finish({"parameters": {name: values.encode_or_describe(value) for name, value in parameters.items()}})


def load(kind: type[Policy], source: Target, device: th.device | str, custom_objects: dict[str, Any] | None) -> Policy:
    """Read a policy.

    :param kind: its class
    :param source: path or binary file object
    :param device: where to put it
    :param custom_objects: constructor arguments that no file can hold
    :raises SnapshotError: naming the file and why it is refused
    """
    device = get_device(device)
    with reading(source, KIND) as archive:
        if set(archive.data) != {"parameters"}:
            raise ValueError("it has other fields than it should")
        parameters = {name: values.decode(value) for name, value in archive.data["parameters"].items()}
        parameters.update(custom_objects or {})
        for name, value in parameters.items():
            if (missing := values.contains_custom(value)) is not None:
                raise ValueError(
                    f"its {name} was {missing.description}, which no file can hold; "
                    f"give it again: load(..., custom_objects={{{name!r}: ...}})"
                )
        found = tensors.read_table(archive, TENSORS)
        constructor: Any = kind
        tensors.compare(
            found, tensors.table_without_memory(lambda: constructor(lr_schedule=_no_schedule, **parameters), found)
        )
        policy: Policy = constructor(lr_schedule=_no_schedule, **parameters)
        policy.load_state_dict(tensors.unpack(archive, TENSORS))
        return policy.to(device)


def _no_schedule(_: float) -> float:
    return 0.0
