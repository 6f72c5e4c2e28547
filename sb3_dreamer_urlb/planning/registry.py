"""From what users write as ``planner=`` to an object."""

from __future__ import annotations

import copy
import dataclasses
import inspect
from collections.abc import Sequence
from typing import Any

from sb3_dreamer_urlb.number_checks import check_dict
from sb3_dreamer_urlb.planning.base import Planner
from sb3_dreamer_urlb.unknown_names import check_keys, did_you_mean

#: by registered name: the fields of the configuration that the name settles, whatever preset or user say about them, such as
#: ``use_value=False`` of ``"mppi"``; filled by :func:`register_planner`
PLANNERS: dict[str, dict[str, Any]] = {}
_KINDS: dict[str, tuple[type[Planner], ...]] = {}


def register_planner(
    name: str, planner: type[Planner], for_choices: type[Planner] | None = None, settled: dict[str, Any] | None = None
) -> None:
    """Let an algorithm's ``planner=name`` mean ``planner``.

    :param name: what users write
    :param planner: subclass of :class:`Planner`
    :param for_choices: the one for Discrete and MultiDiscrete actions; None where ``planner`` takes them, too, or nobody does
    :param settled: fields of the configuration that the name decides, whatever preset or user say about them
    :raises ValueError: if the name means something else already, for anything that is no such subclass, or for fields that
        its configuration does not have
    """
    kinds = (planner,) if for_choices is None else (planner, for_choices)
    for kind in kinds:
        if not (isinstance(kind, type) and issubclass(kind, Planner)):
            raise ValueError(f"The planner {name!r} must be a subclass of Planner, got {kind!r}.")
    if not isinstance(name, str) or not name:
        raise ValueError(f"The name of a planner must be a text, got {name!r}.")
    for kind in kinds:
        fields = (field.name for field in dataclasses.fields(kind.config_class))
        check_keys("settled", settled or {}, fields, kind.config_class.__qualname__)
    if name in _KINDS and (_KINDS[name], PLANNERS[name]) != (kinds, settled or {}):
        raise ValueError(f"The planner {name!r} is already {_KINDS[name][0].__qualname__}.")
    _KINDS[name], PLANNERS[name] = kinds, dict(settled or {})


def registered_planners() -> dict[str, tuple[type[Planner], ...]]:
    """Name → the classes that plan under it."""
    return dict(_KINDS)


def planner_name(planner: str | type[Planner] | Planner | None) -> str | None:
    """For people: the name a planner is registered under, else that of its class; None for none."""
    if planner is None or isinstance(planner, str):
        return planner
    kind = planner if isinstance(planner, type) else type(planner)
    return next((name for name, kinds in _KINDS.items() if kind in kinds), kind.__qualname__)


def make_planner(
    planner: str | type[Planner] | Planner | None,
    kwargs: dict[str, Any] | None,
    gae_lambda: float,
    classes: Sequence[int] | None = (),
) -> Planner | None:
    """Build the planner that a user asked for.

    :param planner: a registered name, a class, an instance (of which a copy is used), or None to act with the actor
    :param kwargs: fields of its configuration to change; those that the name settles are ignored
    :param gae_lambda: λ of the critic
    :param classes: number of classes of each choice that is an action; empty where actions are numbers; None checks
        the arguments only, whatever the actions, and builds nothing
    :raises ValueError: for an unknown name, an unknown field or a value out of range, or actions it does not plan
    """
    check_dict("planner_kwargs", kwargs)
    if isinstance(planner, Planner):
        if kwargs:
            raise ValueError(
                f"planner_kwargs={kwargs} need the name or the class of a planner, got the instance {planner_name(planner)}."
            )
        if classes is not None and planner.classes != tuple(classes):
            raise ValueError(
                f"The planner {planner_name(planner)} chooses among the classes {planner.classes}, "
                f"the actions have {tuple(classes)}."
            )
        return copy.deepcopy(planner)
    if not (planner is None or isinstance(planner, str) or (isinstance(planner, type) and issubclass(planner, Planner))):
        raise ValueError(f"planner must be a name, a subclass or an instance of Planner, or None, got {planner!r}.")
    if isinstance(planner, type) and inspect.isabstract(planner):
        lacking = ", ".join(sorted(planner.__abstractmethods__))
        raise ValueError(f"planner must be a class that plans, {planner.__qualname__} lacks {lacking}.")
    if isinstance(planner, str) and planner not in _KINDS:
        meant = did_you_mean([planner], _KINDS)
        raise ValueError(f"Unknown planner {planner!r}; known are {sorted(_KINDS)} and None for the actor.{meant}")
    kind, settled = _kind(planner, classes), PLANNERS.get(planner, {}) if isinstance(planner, str) else {}
    check_keys("planner_kwargs", kwargs or {}, (field.name for field in dataclasses.fields(kind.config_class)))
    config = kind.config_class(**{**(kwargs or {}), **settled})
    if planner is None or classes is None:
        return None
    return kind(config, gae_lambda, classes)


def _kind(planner: str | type[Planner] | None, classes: Sequence[int] | None) -> type[Planner]:
    """The class for these actions."""
    if isinstance(planner, type):
        return planner
    kinds = _KINDS["dyna_mpc" if planner is None else planner]
    return kinds[-1] if classes else kinds[0]
