"""What a planner is: the interface that the policy acts through."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from itertools import chain
from typing import Any, ClassVar

import torch as th

from sb3_dreamer_urlb.planning.config import PlannableModel, PlannerConfig
from sb3_dreamer_urlb.types import LatentState


class Planner(ABC):
    """Chooses actions by looking ahead in the model. n environments, H horizon, A action size.

    A subclass keeps the constructor: hyperparameters of its own are fields of a dataclass that extends :class:`PlannerConfig`,
    named by ``config_class``. So planners are saved by their name and their arguments.

    :param config: hyperparameters
    :param gae_lambda: λ of the returns that rank trajectories, the one the critic was trained with
    :param classes: number of classes of each choice that is an action; empty where actions are numbers
    :raises ValueError: for a configuration of another kind, or actions that this planner does not choose
    """

    #: kind of ``config``; what ``planner_kwargs`` may name
    config_class: ClassVar[type[PlannerConfig]] = PlannerConfig
    #: whether a policy plans with it
    in_use = False
    #: whether actions may be numbers in [-1, 1], and choices among classes (one-hot)
    plans_numbers: ClassVar[bool] = True
    plans_choices: ClassVar[bool] = False

    def __init__(self, config: PlannerConfig, gae_lambda: float, classes: Sequence[int] = ()):
        name = type(self).__qualname__
        if not isinstance(config, self.config_class):
            raise ValueError(f"{name} needs a {self.config_class.__qualname__}, got {config!r}.")
        if not (self.plans_choices if classes else self.plans_numbers):
            kind = "Discrete or MultiDiscrete" if classes else "Box"
            raise ValueError(f"{name} does not plan {kind} actions: derive it from {'Categorical' * bool(classes)}DynaMPC.")
        self.config = config
        self.gae_lambda = gae_lambda
        self.classes: tuple[int, ...] = tuple(classes)

    def __setattr__(self, name: str, value: Any) -> None:
        """As ever, until a policy plans with it: from then on the model says what it is, and saves that.

        :raises AttributeError: for its settings then
        """
        if self.in_use and name in ("config", "gae_lambda", "classes"):
            raise AttributeError(
                f"The {name} of a policy's planner is not changed by hand, for the model would save and fine-tune with the "
                f"old one, got {value!r}: give planner_kwargs to the model, or to its load()."
            )
        super().__setattr__(name, value)

    @abstractmethod
    def plan(
        self,
        model: PlannableModel,
        state: LatentState,
        previous_mean: th.Tensor,
        generator: th.Generator | None,
        explore: bool,
    ) -> tuple[th.Tensor, th.Tensor]:
        """Choose an action for each environment.

        :param model: what to plan in
        :param state: current posterior states, (n, …)
        :param previous_mean: the mean that the last step returned, zeros where an episode begins, float (n, H, A)
        :param generator: source of randomness, the global one if None
        :param explore: add the planner's noise to the action
        :return: action in [-1, 1], float (n, A), and the mean to hand in at the next step, float (n, H, A)
        """

    def returned(self, method: str, given: Any, *shapes: Sequence[int | None]) -> Any:
        """What a method gave, which a subclass may have written, if it has the right form.

        :param method: its name
        :param given: what it returned
        :param shapes: of the tensors that it must return; None stands for one number, the same in all of them
        :raises ValueError: for anything else, naming class, method and both forms
        """
        found = given if isinstance(given, tuple) else (given,)
        if all(isinstance(one, th.Tensor) for one in found) and _of_form([one.shape for one in found], shapes):
            return given
        wanted_form = ", ".join(str(tuple(shape)).replace("None", "k") for shape in shapes)
        form = ", ".join(str(tuple(one.shape)) if isinstance(one, th.Tensor) else type(one).__name__ for one in found)
        raise ValueError(f"{type(self).__qualname__}.{method} must return {wanted_form}, got {form}.")


def _of_form(found: Sequence[Sequence[int]], wanted: Sequence[Sequence[int | None]]) -> bool:
    """Whether shapes are as wanted, and all sizes that are free, None, are one."""
    if [*map(len, found)] != [*map(len, wanted)]:
        return False
    pairs = [*zip(chain(*found), chain(*wanted), strict=True)]
    free = {size for size, expected in pairs if expected is None}
    return len(free) <= 1 and all(expected in (None, size) for size, expected in pairs)
