"""The benchmark's four Jaco tasks: reach one corner of the table (URLB, Laskin et al. 2021).

They are dm_control's reach task with a Duplo brick, only that the brick always starts in the same place. The reward is
1 while the hand is within 5 cm of the brick and falls to 0.1 at 10 cm; the hand starts 27 to 46 cm away. The brick is
free to move, and the reward follows it.
"""

# ruff: noqa: E402 - dm_control must be imported without OpenGL, see load_physics
from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from sb3_dreamer_urlb.envs.rendering import load_physics

load_physics()

from dm_control import composer
from dm_control.composer.observation import observable
from dm_control.entities import props
from dm_control.manipulation import reach
from dm_control.manipulation.shared import arenas, constants, observations, registry, robots, workspaces
from dm_control.utils import rewards

_TIME_LIMIT = 10.0  # seconds: 250 control steps; that of all of dm_control's manipulation tasks
_BRICK_Z = 0.001  # metres: just above the table, on which it then settles

# Where the brick starts, (x, y) in metres, seen from the front camera.
_BRICK_XY = {
    "reach_top_left": (-0.09, 0.09),
    "reach_top_right": (0.09, 0.09),
    "reach_bottom_left": (-0.09, -0.09),
    "reach_bottom_right": (0.09, -0.09),
}

# Metres within which the reward is 1, and from there on to 0.1. The paper gives no numbers for its sparser and denser
# variants, only that their maximum is the same: half and twice the benchmark's are our choice.
_REWARDED = {"": (0.05, 0.05), "fixed": (0.05, 0.05), "sparse": (0.025, 0.025), "dense": (0.1, 0.1)}


class _Workspace(NamedTuple):
    """What dm_control's ``Reach`` asks of a workspace.

    :param target_bbox: where the brick starts
    :param tcp_bbox: where the hand's tool centre point starts
    :param arm_offset: where the arm stands
    """

    target_bbox: workspaces.BoundingBox
    tcp_bbox: workspaces.BoundingBox
    arm_offset: tuple[float, float, float]


class ReachVariant(reach.Reach):
    """Reach as in the paper's extended analysis and its study of sparsity.

    :param target: where the reward's target is, (x, y, z) in metres, wherever the brick goes; None for the brick
    :param radius: metres around it within which the reward is 1
    :param margin: metres further out at which it has fallen to 0.1
    :param arguments: of dm_control's ``Reach``
    """

    def __init__(self, target: tuple[float, float, float] | None, radius: float, margin: float, **arguments: Any) -> None:
        super().__init__(**arguments)
        self._fixed_target, self._radius, self._margin = target, radius, margin

    def get_reward(self, physics: Any) -> float:
        """In [0, 1], by the distance of the hand's tool centre point."""
        hand = physics.bind(self._hand.tool_center_point).xpos
        target = physics.bind(self._target).xpos if self._fixed_target is None else self._fixed_target
        return rewards.tolerance(np.linalg.norm(hand - target), bounds=(0, self._radius), margin=self._margin)


def make_jaco_task(task: str) -> composer.Environment:
    """One of the four reach tasks, or a variant of one.

    :param task: ``reach_top_left``, ``reach_top_right``, ``reach_bottom_left`` or ``reach_bottom_right``; with ``-fixed`` the
        brick may move but not the target, with ``-sparse`` and ``-dense`` the rewarded area is smaller and larger
    :return: the bare composer environment, unseeded
    """
    # The camera is off: an enabled one renders at every control step; we render once per agent step, and get the same pixels.
    # What is observed changes nothing but the state that is handed out: the benchmark's state variants have these settings.
    settings = observations.PERFECT_FEATURES

    corner, _, variant = task.partition("-")
    radius, margin = _REWARDED[variant]
    brick_position = (*_BRICK_XY[corner], _BRICK_Z)
    workspace = _Workspace(
        target_bbox=workspaces.BoundingBox(lower=brick_position, upper=brick_position),
        tcp_bbox=workspaces.BoundingBox(lower=(-0.1, -0.1, 0.2), upper=(0.1, 0.1, 0.4)),
        arm_offset=robots.ARM_OFFSET,
    )
    reach_task = ReachVariant(
        brick_position if variant == "fixed" else None,
        radius,
        margin,
        arena=arenas.Standard(),
        arm=robots.make_arm(obs_settings=settings),
        hand=robots.make_hand(obs_settings=settings),
        prop=props.Duplo(observable_options=observations.make_options(settings, observations.FREEPROP_OBSERVABLES)),
        obs_settings=settings,
        workspace=workspace,
        control_timestep=constants.CONTROL_TIMESTEP,
    )
    # Composer compiles the model anew each episode. That costs 0.3 s of rendering set-up, and is kept: without it all
    # episodes but the first differ from the benchmark's.
    return composer.Environment(reach_task, time_limit=_TIME_LIMIT)


def make_manipulation_task(task: str) -> composer.Environment:
    """Any of dm_control's own manipulation tasks, which show the same arm.

    :param task: a name of ``dm_control.manipulation.ALL``
    :return: the bare composer environment, unseeded, with its cameras' observables off (as for the reach tasks)
    """
    manipulation_task = registry.get_constructor(task)()
    for feature in manipulation_task.observables.values():
        if isinstance(feature, observable.MJCFCamera):
            feature.enabled = False
    return composer.Environment(manipulation_task, time_limit=_TIME_LIMIT)
