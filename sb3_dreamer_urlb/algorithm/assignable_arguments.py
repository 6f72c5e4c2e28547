"""What happens when an argument is assigned on a model: it is in force from then on, or refused."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

import numpy as np

from sb3_dreamer_urlb.devices import known_device
from sb3_dreamer_urlb.number_checks import plain
from sb3_dreamer_urlb.replay import SequenceReplayBuffer
from sb3_dreamer_urlb.snapshots.saved_algorithm import ATTRIBUTES, SavedAlgorithm

#: an argument that files do not hold
DEVICE = "device"
#: what a model makes itself
PARTS = ("policy", "replay_buffer")


class AssignableArguments(SavedAlgorithm):
    """What a model says of its arguments is what is in force, for files state it."""

    #: arguments that are in force from the next step or update on when they are assigned; None lets all be assigned unchecked
    assignable: ClassVar[frozenset[str] | None] = None
    #: arguments that networks were built with, so that no file of them can be loaded with others
    of_the_networks: ClassVar[frozenset[str]] = frozenset()
    #: arguments that decide what fine-tuning trains
    before_fine_tuning: ClassVar[frozenset[str]] = frozenset()

    #: whether the model makes its own parts
    _builds = False
    #: dictionaries among the arguments, as they are in force
    _dictionaries: dict[str, dict[str, Any]]

    def __setattr__(self, name: str, value: Any) -> None:
        """As ever, but for arguments of a model that is built.

        :raises AttributeError: for an argument that networks or replay were built with
        :raises ValueError: for a value that does not fit; the old one stays
        """
        if name in PARTS and "policy" in vars(self) and not self._builds:
            self._check_part(name, value)
        self._assign(name, value)
        if self.assignable is not None and "policy" in vars(self) and (name == "policy" or name in self.assignable):
            found = {one: vars(self).get(one) for one in _watched_arguments(type(self))}
            super().__setattr__("_dictionaries", {one: plain(its) for one, its in found.items() if isinstance(its, dict)})

    @contextmanager
    def _building(self) -> Iterator[None]:
        """Inside, the model makes its own parts."""
        self._builds = True
        try:
            yield
        finally:
            self._builds = False

    def _check_part(self, name: str, part: Any) -> None:
        """
        :raises AttributeError: for another policy, which nothing would train
        :raises ValueError: for a replay of another form, or of another phase; None is none
        """
        # One that was compiled has the same networks.
        if name == "policy" and getattr(part, "agent", None) is not self.policy.agent:
            raise AttributeError(
                "policy cannot be assigned: its networks are those that the learner trains. To take weights over: "
                "model.policy.load_state_dict(other.state_dict()), model.set_parameters(...), or load a model."
            )
        if name == "replay_buffer" and isinstance(part, SequenceReplayBuffer):
            expected = {one: getattr(self, one) for one in ("phase", "n_envs", "observation_space", "action_space")}
            if (mine := vars(self).get(name)) is not None:
                expected |= {one: getattr(mine, one) for one in ("batch_length", "skill_size", "tasks")}
            wrong = [one for one, value in expected.items() if getattr(part, one) != value]
            its, own = (", ".join(f"{one}={get(one)!r}" for one in wrong) for get in (part.__getattribute__, expected.get))
            if wrong:
                raise ValueError(f"replay_buffer must be one of this model in this phase, with {own}; this one has {its}.")

    def take_over_changes(self) -> None:
        """What was changed within a dictionary was assigned: nobody heard of it.

        :raises AttributeError: as for assigning; the old values are back then
        :raises ValueError: likewise
        """
        for name, before in vars(self).get("_dictionaries", {}).items():
            now = vars(self)[name]
            if not same(before, now):
                super().__setattr__(name, plain(before))
                self.__setattr__(name, now)

    def _assign(self, name: str, value: Any) -> None:
        if self.assignable is None or "policy" not in vars(self) or name not in _watched_arguments(type(self)):
            super().__setattr__(name, value)
            return
        if name == DEVICE and known_device(value) == self.device:
            return
        if name not in self.assignable:
            raise AttributeError(
                f"{name} cannot be assigned: the model was built with {name}={self._as_built(name)!r}. "
                f"To change it: {self._how_to_change(name)}."
            )
        before = vars(self)[name]
        super().__setattr__(name, plain(value))
        try:
            self._put_in_force()
        except Exception:
            super().__setattr__(name, before)
            raise

    def _as_built(self, name: str) -> Any:
        return str(self.device) if name == DEVICE else vars(self).get(ATTRIBUTES.get(name, name))

    def _how_to_change(self, name: str) -> str:
        """What works for an argument that cannot be assigned."""
        me = type(self).__name__
        if name in self.of_the_networks:
            return f"make another model, {me}(..., {name}=...), for the networks of this one and of its files keep theirs"
        if name in self.before_fine_tuning:
            return (
                f"make another model, or load the pre-trained one with it, {me}.load(path, {name}=...), and then fine_tune()"
            )
        return f"{me}.load(path, {name}=...)"

    def _put_in_force(self) -> None:
        """An argument was assigned: check all of them, and tell the parts that hold a copy.

        :raises ValueError: for a value that does not fit; nothing is told yet
        """


def same(a: Any, b: Any) -> bool:
    """Whether two values of an argument are equal, arrays in them included."""
    if isinstance(a, dict) and isinstance(b, dict):
        return a.keys() == b.keys() and all(same(value, b[key]) for key, value in a.items())
    if type(a) is type(b) and isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(same, a, b))
    return a is b or np.array_equal(a, b)


@functools.cache
def _watched_arguments(algorithm: type[AssignableArguments]) -> frozenset[str]:
    """The arguments of the class that says which of them may be assigned; what subclasses add is their own affair."""
    owner = next(kind for kind in algorithm.__mro__ if "assignable" in vars(kind))
    return frozenset({*owner.argument_names(), DEVICE})  # type: ignore[attr-defined]
