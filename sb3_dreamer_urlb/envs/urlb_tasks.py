"""The eight walker and quadruped tasks of the benchmark.

Five come from dm_control's suite as they are. Walker flip and quadruped stand and jump are the benchmark's own (URLB,
Laskin et al. 2021; used from pixels in "Mastering the Unsupervised Reinforcement Learning Benchmark from Pixels", ICML
2023): new rewards on the suite's own models, which are compiled here from the suite's XML.
"""

# ruff: noqa: E402 - dm_control must be imported without OpenGL, see load_physics
from __future__ import annotations

import numpy as np

from sb3_dreamer_urlb.envs.rendering import load_physics
from sb3_dreamer_urlb.envs.suite_tasks import load_suite_task

load_physics()

from dm_control import suite
from dm_control.rl import control
from dm_control.suite import base, common, quadruped, walker
from dm_control.utils import rewards

# Seconds, as in the suite: 1000 control steps an episode for both.
_WALKER_TIME_LIMIT, _WALKER_CONTROL_STEP = 25, 0.025
_QUADRUPED_TIME_LIMIT, _QUADRUPED_CONTROL_STEP = 20, 0.02
_QUADRUPED_FLOOR = 10  # half-size in metres, that of the suite's walk task; the floor shows in the pixels

_QUADRUPED_WALK_SPEED = 0.5  # m/s at which dm_control's walk earns its full reward

_FLIP_MOMENTUM = 5.0  # kg m²/s about +y at which the flip term is 1
_JUMP_HEIGHT = 1.0  # height of the centre of mass in metres at which the jump term is 1


def angular_momentum(physics: walker.Physics) -> float:
    """Of the walker's whole body about its centre of mass and the world's y axis, in kg m²/s."""
    return float(physics.named.data.subtree_angmom["torso"][1])


class FlipPhysics(walker.Physics):
    """The walker's physics, which also tells how fast the body spins."""

    def angular_momentum(self) -> float:
        """Of the whole body about its centre of mass and the world's y axis, in kg m²/s."""
        return angular_momentum(self)


class Flip(walker.PlanarWalker):
    """Spin forwards, on the feet as far as possible."""

    def __init__(self) -> None:
        super().__init__(move_speed=0)  # the parent's reward is then that for standing

    def get_reward(self, physics: walker.Physics) -> float:
        """stand · (5·flip + 1) / 6, in [0, 1]."""
        flip = rewards.tolerance(
            angular_momentum(physics),
            bounds=(_FLIP_MOMENTUM, np.inf),
            margin=_FLIP_MOMENTUM,
            value_at_margin=0,
            sigmoid="linear",
        )
        return super().get_reward(physics) * (5 * flip + 1) / 6


class Stand(quadruped.Move):
    """Get the torso upright from a random orientation."""

    def __init__(self) -> None:
        super().__init__(desired_speed=0)

    def get_reward(self, physics: quadruped.Physics) -> float:
        """How upright the torso is: 0 upside down, 1/2 on its side, 1 upright."""
        return rewards.tolerance(physics.torso_upright(), bounds=(1, np.inf), margin=2, value_at_margin=0, sigmoid="linear")


class Jump(Stand):
    """Get the centre of mass high up, upright."""

    def get_reward(self, physics: quadruped.Physics) -> float:
        """upright · height, in [0, 1]."""
        height = rewards.tolerance(
            physics.named.data.sensordata["center_of_mass"][2],
            bounds=(_JUMP_HEIGHT, np.inf),
            margin=_JUMP_HEIGHT,
            value_at_margin=0.5,
            sigmoid="linear",
        )
        return super().get_reward(physics) * height


class UprightMove(quadruped.Move):
    """As the Real-World RL suite begins its episodes: upright, turned at random about the vertical."""

    def initialize_episode(self, physics: quadruped.Physics) -> None:
        """Set the state of an episode's start."""
        azimuth = self.random.uniform(0, 2 * np.pi)
        orientation = np.array((np.cos(azimuth / 2), 0, 0, np.sin(azimuth / 2)))
        quadruped._find_non_contacting_height(physics, orientation)
        base.Task.initialize_episode(self, physics)


def make_upright_walk() -> control.Environment:
    """The quadruped's walk of the Real-World RL suite, not perturbed: dm_control's, but that it starts on its feet.

    :return: the control environment, unseeded
    """
    env = suite.load("quadruped", "walk")
    return control.Environment(
        env.physics,
        UprightMove(desired_speed=_QUADRUPED_WALK_SPEED),
        time_limit=_QUADRUPED_TIME_LIMIT,
        control_timestep=_QUADRUPED_CONTROL_STEP,
    )


def make_suite_task(domain: str, task: str) -> control.Environment:
    """One of the benchmark's walker and quadruped tasks, or any task of dm_control's suite.

    :param domain: a domain of the suite
    :param task: a task of the suite in that domain, or walker flip, quadruped stand, quadruped jump
    :return: the control environment, unseeded
    :raises ValueError: if the suite does not know the task
    """
    if (domain, task) == ("walker", "flip"):
        physics = FlipPhysics.from_xml_string(*walker.get_model_and_assets())
        return control.Environment(physics, Flip(), time_limit=_WALKER_TIME_LIMIT, control_timestep=_WALKER_CONTROL_STEP)
    if domain == "quadruped" and task in ("stand", "jump"):
        xml = quadruped.make_model(floor_size=_QUADRUPED_FLOOR)
        return control.Environment(
            quadruped.Physics.from_xml_string(xml, common.ASSETS),
            Stand() if task == "stand" else Jump(),
            time_limit=_QUADRUPED_TIME_LIMIT,
            control_timestep=_QUADRUPED_CONTROL_STEP,
        )
    return load_suite_task(domain, task)
