"""What files hold by a registered name, planners and intrinsic rewards, and what to do where a name is not known."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from sb3_dreamer_urlb.intrinsic import ExplorationMethod, registered_intrinsic_rewards
from sb3_dreamer_urlb.planning import registered_planners
from sb3_dreamer_urlb.snapshots import values

#: by argument, what can be done where its value cannot be had again
ANOTHER = {"planner": 'load(..., planner="dyna_mpc")'}


@dataclass(frozen=True)
class Registry:
    """What an argument may be by name.

    :param register: the function that makes a name known
    :param kinds: by name, the class
    """

    register: str
    kinds: Mapping[str, type]


def registries() -> dict[str, Registry]:
    """By constructor argument, as they are now."""
    planners = {name: kinds[0] for name, kinds in registered_planners().items()}
    return {
        "planner": Registry("register_planner", planners),
        "intrinsic_reward": Registry("register_intrinsic_reward", registered_intrinsic_rewards(ExplorationMethod)),
    }


def registered_name(stored: Any) -> str | None:
    """The name that a file knows an argument's value by.

    :param stored: JSON of the value
    """
    name = stored.get("name") if isinstance(stored, dict) and stored.get(values.TAG) in values.BY_NAME else stored
    return name if isinstance(name, str) else None


def check_registered(stored: Mapping[str, Any], given: Mapping[str, Any]) -> None:
    """Whether what a file names is known here.

    :param stored: arguments of the file, as JSON
    :param given: those of the caller, which replace them
    :raises ValueError: for a name that whoever saved the model registered, and nobody here
    """
    for argument, registry in registries().items():
        name = registered_name(stored.get(argument))
        if argument not in given and name is not None and name not in registry.kinds:
            raise ValueError(
                f"its {argument} is {name!r}, which is not registered here; known are {sorted(registry.kinds)}. First "
                f"{registry.register}({name!r}, ItsClass){or_another(argument)}"
            )


def or_another(argument: str) -> str:
    """The end of a message about a value that is not there.

    :param argument: whose
    """
    return f", or another one: {ANOTHER[argument]}" if argument in ANOTHER else ""
