"""A row from its texts: what cannot be read is told apart from what is about unknown things."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import replace

from sb3_dreamer_urlb.evaluation.names import UnknownName, method_name, task_name
from sb3_dreamer_urlb.evaluation.row import FALSE, FLAGS, NONE, NUMBERS, REQUIRED, TRUE, WRITTEN, Row

_WRITTEN_FORM = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ|")
_FRAMES = re.compile(r"(?P<number>[+-]?[0-9]+(?:\.[0-9]*)?(?:[eE][+]?[0-9]+)?)\s*(?P<scale>[kKmM]?)\s*(?P<unit>[A-Za-z_ ]*)")
_SCALE = {"": 1, "k": 1_000, "m": 1_000_000}
_INTEGER = re.compile(r"\s*(-?[0-9]+)(?:\.0*)?\s*")
_NUMBER = re.compile(r"\s*[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?\s*")
#: beyond this a number is a mistake; seeds may be as large as generators take them
MOST, MOST_SEED = 10**12, 2**64 - 1


def parse(values: dict[str, str], methods: Iterable[str] = (), tasks: Iterable[str] = (), strict: bool = True) -> Row:
    """A row from its texts.

    :param values: column → text in the order of the file, all required columns among them
    :param methods: further methods that are allowed
    :param tasks: further tasks that are allowed, ``<domain>-<task>``
    :param strict: False allows every method and task
    :raises UnknownName: for an unknown method, task or unit of frames
    :raises ValueError: naming the column, for what cannot be read
    """
    domain, task = (values[name].strip().lower() for name in ("domain", "task"))
    further = {name: text for name, text in values.items() if name not in REQUIRED and text != ""}
    unit = further.get("unit", further.get("frames_unit", "frames"))
    if unit.lower() not in ("frame", "frames", "environment frames"):
        raise UnknownName(f"unknown unit {unit!r} of frames; expected environment frames")
    if next(reversed(values)) == WRITTEN and not _WRITTEN_FORM.fullmatch(values[WRITTEN]):
        raise ValueError(f"{WRITTEN}={values[WRITTEN]!r} is cut off")
    for name, text in further.items():
        if name in NUMBERS:
            _number(name, text)
        elif name in FLAGS and text.strip().lower() not in (*TRUE, *FALSE):
            raise ValueError(f"{name}={text!r}: expected true, false or nothing")
    row = Row(
        method=values["method"].strip(),
        domain=domain,
        task=task,
        seed=_integer("seed", values["seed"], 0, MOST_SEED),
        pretrain_frames=frames("pretrain_frames", values["pretrain_frames"]),
        finetune_frames=frames("finetune_frames", values["finetune_frames"]),
        keep_actor=_truth("keep_actor", values["keep_actor"]),
        keep_critic=_truth("keep_critic", values["keep_critic"]),
        planner=values["planner"].strip() or NONE,
        preset=values["preset"].strip(),
        return_mean=_number("return_mean", values["return_mean"]),
        return_std=_number("return_std", values["return_std"], least=0),
        episodes=_integer("episodes", values["episodes"], 1, MOST),
        seconds=_number("seconds", values["seconds"], least=0),
        further=further,
    )
    # Last: what is cut off may be half a name.
    if strict:
        task_name(domain, task, tasks)
    return replace(row, method=method_name(row.method, methods if strict else [row.method.lower()]))


def frames(name: str, text: str) -> int:
    """A number of environment frames, such as ``2000000``, ``2e6``, ``2M`` or ``100k``.

    :param name: of the column, for the message
    :param text: in the file
    :raises UnknownName: for another unit
    :raises ValueError: for what is no whole number, negative, or more than anybody has
    """
    found = _FRAMES.fullmatch(text.strip())
    if found is None:
        raise ValueError(f"{name}={shown(text)} is no number of frames")
    if found["unit"].strip().lower() not in ("", "frame", "frames"):
        raise UnknownName(f"{name}={text!r}: unknown unit {found['unit'].strip()!r}; expected environment frames")
    number = float(found["number"]) * _SCALE[found["scale"].lower()]
    if not 0 <= number <= MOST or abs(number - round(number)) > 1e-6:
        raise ValueError(f"{name}={shown(text)}: expected a whole number of frames, at least 0 and at most {MOST:.0e}")
    return round(number)


def _integer(name: str, text: str, least: int, most: int) -> int:
    # Never by way of a float: it holds no seed beyond 2^53.
    found = _INTEGER.fullmatch(text) if len(text) < 100 else None
    if found is None or not least <= int(found[1]) <= most:
        raise ValueError(f"{name}={shown(text)}: expected a whole number of at least {least} and at most {most}")
    return int(found[1])


def _number(name: str, text: str, least: float | None = None) -> float:
    """
    :param name: of the column
    :param text: in the file
    :param least: the smallest that makes sense; such a number may be missing, too
    """
    if least is not None and text.strip().lower() in ("", "nan"):
        return math.nan
    number = float(text) if _NUMBER.fullmatch(text) else math.nan
    if not -MOST <= number <= MOST:
        raise ValueError(f"{name}={shown(text)}: expected a finite number, at most {MOST:.0e}")
    if least is not None and number < least:
        raise ValueError(f"{name}={shown(text)}: expected a number of at least {least:g}")
    return number


def _truth(name: str, text: str) -> bool | None:
    plain = text.strip().lower()
    if plain in ("", NONE):
        return None
    if plain not in TRUE + FALSE:
        raise ValueError(f"{name}={shown(text)}: expected true, false or nothing")
    return plain in TRUE


def shown(text: str) -> str:
    """What stands in a file, for a message: never more than a line."""
    return repr(text if len(text) <= 60 else f"{text[:57]}...")
