"""Names that there are not: the answer says which are near."""

from __future__ import annotations

import difflib
from collections.abc import Container, Iterable, Mapping
from types import MappingProxyType
from typing import Any

#: near names that are told
NEAREST = 3


class UnknownNameError(ValueError, TypeError):
    """An argument that there is not: a wrong value as all others are, and the TypeError that Python has for these."""


def nearest(name: str, known: Iterable[str]) -> list[str]:
    """Those that may have been meant, likeliest first: written almost alike, or part of one another.

    :param name: that nobody knows
    :param known: names that there are
    """
    by_case: dict[str, str] = {}
    for each in known:
        by_case.setdefault(each.lower(), each)
    wanted = name.lower()
    if wanted in by_case:
        return [by_case[wanted]]
    alike = difflib.get_close_matches(wanted, by_case, NEAREST)
    parts = sorted(each for each in by_case if len(wanted) > 2 and each not in alike and wanted in each)
    return [by_case[each] for each in [*alike, *parts][:NEAREST]]


def did_you_mean(names: Iterable[Any], known: Iterable[str]) -> str:
    """A question to end a message with, a space in front; empty where nothing is near.

    :param names: that nobody knows
    :param known: names that there are
    """
    known = list(known)
    found = dict.fromkeys(near for name in names for near in nearest(str(name), known))
    return f" Did you mean {' or '.join(map(repr, found))}?" if found else ""


def unexpected_arguments(
    caller: str,
    names: Iterable[str],
    known: Iterable[str],
    listed: str,
    within: Mapping[str, Container[str]] = MappingProxyType({}),
) -> UnknownNameError:
    """The error for keywords of a call with more arguments than a message could list.

    :param caller: what was called
    :param names: keywords that it does not have
    :param known: those that it has
    :param listed: where all of them can be read
    :param within: arguments that are dictionaries → keys that they take
    """
    shown = ", ".join(map(repr, names := list(names)))
    plural = "s" if len(names) > 1 else ""
    places = {name: [which for which, keys in within.items() if name in keys] for name in names}
    found = "".join(
        f" {name} is a key of {' or '.join(which)}: {which[0]}={{{name!r}: ...}}." for name, which in places.items() if which
    )
    near = did_you_mean([name for name in names if not places[name]], known)
    return UnknownNameError(
        f"{caller}: got {'' if plural else 'an '}unexpected keyword argument{plural} {shown}.{found}{near} {listed} lists all."
    )


def check_keys(argument: str, given: Iterable[Any], known: Iterable[str], of: str = "") -> None:
    """Whether there are these keys of a dictionary of arguments, few enough to list.

    :param argument: name of the dictionary
    :param given: its keys
    :param known: keys that there are
    :param of: whose they are, for the message
    :raises UnknownNameError: naming the unknown and the known ones, and which are near
    """
    known = sorted(known)
    unknown = sorted(str(name) for name in given if name not in known)
    if unknown:
        raise UnknownNameError(
            f"Unknown {argument} {unknown}{f' for {of}' if of else ''}; known are {known}.{did_you_mean(unknown, known)}"
        )
