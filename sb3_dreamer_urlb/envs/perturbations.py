"""What the Real-World RL suite does to a task (Dulac-Arnold et al. 2020), as numbers; ``perturbed_control`` does it.

Imports nothing heavy: wrong numbers are refused before MuJoCo loads.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from sb3_dreamer_urlb.envs.options import check_choice
from sb3_dreamer_urlb.number_checks import is_finite_number, is_integer, plain
from sb3_dreamer_urlb.unknown_names import UnknownNameError, did_you_mean

#: the suite's degrees of intensity
LEVELS = ("easy", "medium", "hard")

#: Bodies whose limbs can be stretched, and the name of the perturbation that does.
LIMBS = {"walker": "thigh_length", "quadruped": "shin_length"}

# The suite's combined challenges, which the paper took (Appendix "RWRL settings"), without those of state observations.
_COMMON: dict[str, dict[str, Any]] = {
    "easy": {"action_delay": 3, "reward_delay": 10, "action_repetition": 1, "action_noise": 0.1},
    "medium": {"action_delay": 6, "reward_delay": 20, "action_repetition": 2, "action_noise": 0.3},
    "hard": {"action_delay": 9, "reward_delay": 40, "action_repetition": 3, "action_noise": 1.0},
}
_LENGTHS = {
    "walker": {"easy": (0.225, 0.25), "medium": (0.225, 0.4), "hard": (0.225, 0.55)},
    "quadruped": {"easy": (0.25, 0.3), "medium": (0.25, 0.8), "hard": (0.25, 1.4)},
}
#: The thigh's range at the level hard: the suite's own code has the first, the paper's table the second.
HARD_THIGHS = {"suite": _LENGTHS["walker"]["hard"], "paper": (0.15, 0.55)}

#: Metres that a limb may have. With more, MuJoCo's numbers are soon invalid.
LEAST_LENGTH, MOST_LENGTH = 0.01, 10


@dataclass(frozen=True)
class Perturbations:
    """Any subset of the suite's perturbations; the defaults change nothing. All steps are control steps: with an action repeat
    of 2, an agent step is two of them.

    :param action_delay: control steps between an action and its execution
    :param reward_delay: control steps between a reward and its return
    :param action_repetition: control steps that each (delayed, noisy) action is held for; None and 1 hold none
    :param repetition_probability: of an action to be held; only with ``action_repetition``
    :param action_noise: standard deviation of a normal added to each action, in the task's own units; the result is clipped to
        the task's bounds
    :param thigh_length: half the length of the walker's thighs in metres (0.225 unperturbed): a number, or a range from which
        every episode draws uniformly
    :param shin_length: of the quadruped's shins, their extent down and outwards in metres (0.25 unperturbed), likewise
    :param keep_buffers: the suite never empties its delay buffers: an episode begins with the last one's last actions and
        rewards. False empties them at every reset
    :raises ValueError: naming the perturbation, its value and what was expected
    """

    action_delay: int = 0
    reward_delay: int = 0
    action_repetition: int | None = None
    repetition_probability: float = 1.0
    action_noise: float = 0.0
    thigh_length: float | tuple[float, float] | None = None
    shin_length: float | tuple[float, float] | None = None
    keep_buffers: bool = True

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            object.__setattr__(self, field.name, value.tolist() if isinstance(value, np.ndarray) else plain(value))
        for name in ("action_delay", "reward_delay"):
            self._check(name, is_integer(getattr(self, name)) and getattr(self, name) >= 0, "an int of at least 0")
        held = self.action_repetition
        self._check("action_repetition", held is None or (is_integer(held) and held >= 1), "None or an int of at least 1")
        probability = self.repetition_probability
        self._check("repetition_probability", is_finite_number(probability) and 0 <= probability <= 1, "a number from 0 to 1")
        self._check(
            "repetition_probability",
            held is not None or probability == 1,
            "action_repetition with it: alone it has no effect",
        )
        self._check(
            "action_noise", is_finite_number(self.action_noise) and self.action_noise >= 0, "a finite number of at least 0"
        )
        self._check("keep_buffers", isinstance(self.keep_buffers, bool), "True or False")
        for name in LIMBS.values():
            self._check_length(name)

    def _check_length(self, name: str) -> None:
        """A limb's length, or a range of them, which becomes a tuple."""
        length = getattr(self, name)
        if length is None:
            return
        metres = f"metres, {LEAST_LENGTH} to {MOST_LENGTH}"
        if isinstance(length, list | tuple):
            good = len(length) == 2 and all(map(_is_length, length)) and length[0] <= length[1]
            self._check(name, good, f"a range (least, most) of {metres}")
            object.__setattr__(self, name, (float(length[0]), float(length[1])))
        else:
            self._check(name, _is_length(length), f"{metres}, or a range of them")
            object.__setattr__(self, name, float(length))

    def _check(self, name: str, good: bool, expected: str) -> None:
        if not good:
            raise ValueError(f"{name}={getattr(self, name)!r}: expected {expected}")

    def limb(self, domain: str) -> float | tuple[float, float] | None:
        """The length of a domain's limbs, or their range; None where they stay as they are.

        :param domain: of the task
        :raises ValueError: for limbs that the domain's body does not have
        """
        for body, name in LIMBS.items():
            if body != domain and getattr(self, name) is not None:
                raise ValueError(f"{name}={getattr(self, name)!r}: only the {body} has it, not {domain}")
        length: float | tuple[float, float] | None = getattr(self, LIMBS[domain]) if domain in LIMBS else None
        return length


def _is_length(value: Any) -> bool:
    return is_finite_number(value) and LEAST_LENGTH <= value <= MOST_LENGTH


def make_perturbations(given: Perturbations | Mapping[str, Any] | None) -> Perturbations | None:
    """From what a user or a YAML file says.

    :param given: perturbations, or their arguments by name, or None
    :raises ValueError: naming what is wrong; unknown names are answered with the known ones
    """
    if given is None or isinstance(given, Perturbations):
        return given
    if not isinstance(given, Mapping):
        raise ValueError(f"perturbations={given!r}: expected a dict or Perturbations")
    known = [field.name for field in fields(Perturbations)]
    unknown = [str(name) for name in given if name not in known]
    if unknown:
        meant = did_you_mean(unknown, known)
        raise UnknownNameError(f"unknown perturbation {', '.join(unknown)}: known are {', '.join(known)}.{meant}")
    return Perturbations(**given)


def level(domain: str, name: str, *, hard_thigh: str = "suite", keep_buffers: bool = True) -> Perturbations:
    """One of the suite's combined challenges.

    :param domain: ``walker`` or ``quadruped``
    :param name: ``easy``, ``medium`` or ``hard``
    :param hard_thigh: ``"suite"``: from 0.225, as the code does, with which the published numbers were made; ``"paper"``: from
        0.15, as its table says. Only of the walker's level hard
    :param keep_buffers: see :class:`Perturbations`
    :raises ValueError: naming what is wrong and what there is
    """
    check_choice("domain", domain, tuple(LIMBS), "the Real-World RL suite's levels are of")
    check_choice("level", name, LEVELS)
    check_choice("hard_thigh", hard_thigh, tuple(HARD_THIGHS))
    length = _LENGTHS[domain][name]
    if hard_thigh != "suite":
        if (domain, name) != ("walker", "hard"):
            raise ValueError(f"hard_thigh={hard_thigh!r}: only the walker's level hard has two ranges, not {domain} {name}")
        length = HARD_THIGHS[hard_thigh]
    arguments = {**_COMMON[name], LIMBS[domain]: length}
    return Perturbations(**arguments, keep_buffers=keep_buffers)
