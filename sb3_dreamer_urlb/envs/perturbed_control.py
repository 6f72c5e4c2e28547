"""A dm_control environment under perturbations, control step by control step.

They are the Real-World RL suite's (Dulac-Arnold et al. 2020).
"""

# ruff: noqa: E402 - dm_control must be imported without OpenGL, see load_physics
from __future__ import annotations

import xml.etree.ElementTree as ET
from collections import deque
from typing import Any, Generic, TypeVar

import dm_env
import numpy as np
import numpy.typing as npt

from sb3_dreamer_urlb.envs.perturbations import LIMBS, Perturbations
from sb3_dreamer_urlb.envs.rendering import load_physics

load_physics()

from dm_control import composer
from dm_control.rl import control
from dm_control.suite import common, quadruped

Item = TypeVar("Item")

#: How the quadruped's arena is built for each task: what dm_control's own functions say.
QUADRUPED_ARENAS: dict[str, dict[str, Any]] = {
    "stand": {"floor_size": 10},
    "walk": {"floor_size": 10},
    "jump": {"floor_size": 10},
    "run": {"floor_size": 100},
    "escape": {"floor_size": 40, "terrain": True, "rangefinders": True},
    "fetch": {"walls_and_ball": True},
}


class Delay(Generic[Item]):
    """Gives back what it was given some steps before; at first, what it was given first.

    :param steps: of the delay
    """

    def __init__(self, steps: int):
        self.steps = steps
        self._waiting: deque[Item] = deque()

    def clear(self) -> None:
        self._waiting.clear()

    def __call__(self, item: Item) -> Item:
        self._waiting.append(item)
        return self._waiting.popleft() if len(self._waiting) > self.steps else self._waiting[0]


class PerturbedControl(dm_env.Environment):
    """Steps a dm_control environment as :class:`~sb3_dreamer_urlb.envs.perturbations.Perturbations` say.

    In a control step an action is first delayed, then noise is added and the result clipped to the task's bounds, then it is
    held or replaced by one that is being held. Draws come from ``stream`` in the order in which the suite asks NumPy's global
    one, those included that the suite makes and does not use.

    :param control_env: bare; its physics is replaced at each reset where limbs are stretched
    :param perturbations: what to do
    :param domain: of the task
    :param task: of the domain
    :raises ValueError: for limbs that the body does not have
    """

    def __init__(
        self, control_env: control.Environment | composer.Environment, perturbations: Perturbations, domain: str, task: str
    ):
        self._control, self.perturbations = control_env, perturbations
        self._domain, self._task = domain, task
        self._limb = perturbations.limb(domain)
        #: the limbs' length in this episode, None where they are as they were
        self.length: float | None = None
        #: everything random; replaced by :meth:`seed`
        self.stream = np.random.RandomState()
        self._actions: Delay[npt.NDArray[np.float64]] = Delay(perturbations.action_delay)
        self._rewards: Delay[float] = Delay(perturbations.reward_delay)
        self._held, self._hold_for = np.zeros(()), 0

    def seed(self, seed: int) -> None:
        """Begin anew: a stream of this seed, another than the task's own, and empty buffers.

        :param seed: 0 to 2**32 - 1
        """
        self.stream = np.random.RandomState([seed, 1])
        self._clear()

    def reset(self) -> dm_env.TimeStep:
        """Begin an episode, with limbs of another length.

        :raises RuntimeError: if dm_control finds no pose to begin with; it names the length
        """
        if not self.perturbations.keep_buffers:
            self._clear()
        if self._limb is not None:
            self.length = self._draw_length()
            self._control.physics.free()
            self._control._physics = _stretched(self._control.physics, self._domain, self._task, self.length)
        try:
            return self._control.reset()
        except RuntimeError as error:  # below 10 cm of shin, the quadruped always touches the ground
            if self._limb is None or isinstance(error, control.PhysicsError):
                raise
            raise RuntimeError(
                f"{LIMBS[self._domain]}={self.length}: {self._domain}-{self._task} cannot begin: {error}"
            ) from error

    def step(self, action: npt.NDArray[np.float64]) -> dm_env.TimeStep:
        """One control step.

        :param action: as the environment takes it
        """
        time_step = self._control.step(self._executed(action))
        if self.perturbations.reward_delay:
            time_step = time_step._replace(reward=self._rewards(time_step.reward))
        return time_step

    def observation_spec(self) -> Any:
        return self._control.observation_spec()

    def action_spec(self) -> Any:
        return self._control.action_spec()

    def control_timestep(self) -> float:
        return float(self._control.control_timestep())

    def close(self) -> None:
        self._control.close()

    @property
    def physics(self) -> Any:
        """The bare environment's; another after a reset that stretches limbs."""
        return self._control.physics

    # Where Shimmy looks for what it wraps and for the task's stream: the suite's in the task, composer's in the environment.

    @property
    def _env(self) -> Any:
        return self._control

    @property
    def task(self) -> Any:
        """The bare environment's."""
        return self._control.task

    @property
    def _random_state(self) -> np.random.RandomState:
        stream: np.random.RandomState = self._control._random_state
        return stream

    @_random_state.setter
    def _random_state(self, stream: np.random.RandomState) -> None:
        self._control._random_state = stream

    def _clear(self) -> None:
        self._actions.clear()
        self._rewards.clear()
        self._hold_for = 0

    def _executed(self, action: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """What becomes of an action."""
        wanted = self.perturbations
        if wanted.action_delay:
            action = self._actions(np.array(action))
        if wanted.action_noise:
            spec = self._control.action_spec()
            action = np.clip(self.stream.normal(action, wanted.action_noise), spec.minimum, spec.maximum)
        if wanted.action_repetition is None:
            return action
        if self._hold_for > 0:
            action = self._held
            self._hold_for -= 1
        elif self.stream.uniform() < wanted.repetition_probability:
            self._hold_for = wanted.action_repetition - 1
        self._held = action
        return action

    def _draw_length(self) -> float:
        """Of the limbs, for one episode."""
        self.stream.normal()  # of a schedule that walks at random, which neither of ours is
        assert self._limb is not None
        return float(self.stream.uniform(*self._limb)) if isinstance(self._limb, tuple) else self._limb


def _stretched(physics: Any, domain: str, task: str, length: float) -> Any:
    """New physics of the same class, of a model with other limbs.

    :param physics: the old one
    :param domain: ``walker`` or ``quadruped``
    :param task: of that domain
    :param length: of the walker's thighs or the quadruped's shins, as in ``Perturbations``
    """
    if domain == "walker":
        model = ET.fromstring(common.read_model("walker.xml"))
        for side in ("left", "right"):
            for thigh in model.iterfind(f".//geom[@name='{side}_thigh']"):
                thigh.set("pos", f"0 0 {-length}")
                thigh.set("size", f"0.05 {length}")
            for leg in model.iterfind(f".//body[@name='{side}_leg']"):
                leg.set("pos", f"0 0 {-0.25 - 2 * length}")
    else:
        model = ET.fromstring(quadruped.make_model(**QUADRUPED_ARENAS[task]))
        for knee in model.iterfind(".//default[@class='knee']/geom"):
            knee.set("fromto", f"0 0 0 {length} 0 {-length}")
        for body in model.iterfind(".//body"):
            if body.get("name", "").startswith("ankle_"):
                body.set("pos", f"{length} 0 {-length}")
    return type(physics).from_xml_string(ET.tostring(model), common.ASSETS)
