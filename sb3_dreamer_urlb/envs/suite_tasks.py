"""dm_control's suite, without two of its habits: OpenGL at a reset, and a model that no reset's seed draws."""

# ruff: noqa: E402 - dm_control must be imported without OpenGL, see load_physics
from __future__ import annotations

from typing import Any

import dm_env
import numpy as np

from sb3_dreamer_urlb.envs.rendering import load_physics

load_physics()

from dm_control import suite
from dm_control.rl import control
from dm_control.suite import base, lqr


def load_suite_task(domain: str, task: str) -> control.Environment:
    """A task of dm_control's suite. No OpenGL is loaded before somebody renders, and ``reset()`` after a new random stream was
    given to the task begins as ``suite.load`` with that stream does.

    :param domain: of the suite
    :param task: of that domain
    :return: unseeded
    :raises ValueError: if the suite does not know the task
    """
    env = suite.load(domain, task)
    if domain == "lqr":
        env = DrawnModel(env.physics, env.task)
    env.task.initialize_episode = WithoutNewContext(env.task)
    return env


class WithoutNewContext:
    """A task's ``initialize_episode`` that makes no OpenGL context.

    Quadruped escape changes its ground, and copies it to ``physics.contexts``, which makes a context where there is none. But
    a context is made from the model as it then is: before the first frame there is nothing to copy.

    :param task: whose method it stands for
    """

    def __init__(self, task: base.Task):
        self._task = task

    def __call__(self, physics: Any) -> None:
        """Set the state of an episode's start.

        :param physics: of the suite; its context is used if it has one
        """
        physics._make_rendering_contexts = _nothing
        try:
            type(self._task).initialize_episode(self._task, physics)
        finally:
            del physics._make_rendering_contexts


def _nothing() -> None:
    """In place of making a context: ``physics.contexts`` stays None."""


class DrawnModel(control.Environment):
    """The suite's LQR, whose springs are drawn when it is loaded: they are drawn anew when the task gets another stream."""

    def __init__(self, physics: Any, task: base.Task):
        super().__init__(physics, task)
        self._drawn_from: np.random.RandomState = task.random

    def reset(self) -> dm_env.TimeStep:
        """Begin an episode, of another model if the task has another stream than at the last one."""
        if self.task.random is not self._drawn_from:
            self._drawn_from = self.task.random
            old: Any = self.physics
            drawn = lqr.get_model_and_assets(old.model.nq, old.model.nu, self._drawn_from)
            self._physics: Any = type(old).from_xml_string(*drawn)
            old.free()
        return super().reset()
