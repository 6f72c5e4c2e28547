"""What evaluations may be about: methods with their category, tasks, and what an id says. Imports nothing heavy."""

from __future__ import annotations

import sys
from collections.abc import Iterable
from dataclasses import dataclass

from sb3_dreamer_urlb.envs.registration import URLB_TASKS


@dataclass(frozen=True)
class Method:
    """A way to explore, or a baseline.

    :param label: in figures and tables
    :param category: as the paper groups them (§2): ``data``, ``knowledge``, ``competence``, ``random``; ``none`` without
        pre-training; ``other`` for methods from outside the package
    """

    label: str
    category: str


METHODS: dict[str, Method] = {
    "icm": Method("ICM", "knowledge"),
    "lbs": Method("LBS", "knowledge"),
    "plan2explore": Method("P2E", "knowledge"),
    "rnd": Method("RND", "knowledge"),
    "disagreement": Method("Disagreement", "knowledge"),
    "apt": Method("APT", "data"),
    "aps": Method("APS", "competence"),
    "diayn": Method("DIAYN", "competence"),
    "random": Method("Random", "random"),
    "dreamer": Method("DreamerV2", "none"),
    "drqv2": Method("DrQv2", "none"),
}

#: what the same methods are called elsewhere → their name here
ALIASES: dict[str, str] = {
    "p2e": "plan2explore",
    "dreamerv2": "dreamer",
    "dreamer_v2": "dreamer",
    "drq": "drqv2",
    "drq_v2": "drqv2",
    "drq-v2": "drqv2",
}

CATEGORIES: tuple[str, ...] = ("data", "knowledge", "competence", "random")

#: ``<domain>-<task>`` of the benchmark, in the order of its table
TASKS: tuple[str, ...] = tuple(f"{domain}-{task}" for domain, tasks in URLB_TASKS.items() for task in tasks)

#: levels of the perturbations (paper, appendix "RWRL")
LEVELS = ("easy", "medium", "hard")
#: rewards of the reaching tasks (paper, appendix "On the sparsity of the Jaco tasks")
VARIANTS = ("fixed", "sparse", "dense")


class UnknownName(ValueError):
    """A task, a method or a unit that nobody knows: it is refused, as scores of it would mean nothing."""


def method_name(name: str, also: Iterable[str] = ()) -> str:
    """The name of a method as this package writes it.

    :param name: as somebody wrote it
    :param also: further names that are allowed
    :raises UnknownName: listing the known ones
    """
    plain = name.strip().lower()
    plain = ALIASES.get(plain, plain)
    known = {*METHODS, *_registered(), *also}
    if plain not in known:
        raise UnknownName(f"unknown method {name!r}; known are {', '.join(sorted(known))}")
    return plain


def method(name: str) -> Method:
    """Label and category of a method.

    :param name: known or not
    """
    return METHODS.get(name, Method(name, "other"))


def task_name(domain: str, task: str, also: Iterable[str] = ()) -> str:
    """``<domain>-<task>``.

    :param domain: of the task
    :param task: in that domain
    :param also: further tasks that are allowed, written ``<domain>-<task>``
    :raises UnknownName: listing the known ones
    """
    name, known = f"{domain}-{task}", (*TASKS, *also)
    if name not in known:
        raise UnknownName(f"unknown task {name!r}; known are {', '.join(known)}")
    return name


def counted(number: int, one: str, many: str | None = None) -> str:
    """``1 episode``, ``2 episodes``.

    :param number: of things
    :param one: what one of them is called
    :param many: and several, with an s if None
    """
    return f"{number} {one if number == 1 else many or one + 's'}"


def _registered() -> Iterable[str]:
    # Methods that a program added itself: then the registry is imported already, and torch with it.
    registry = sys.modules.get("sb3_dreamer_urlb.intrinsic.registry")
    return () if registry is None else registry.registered_intrinsic_rewards()
