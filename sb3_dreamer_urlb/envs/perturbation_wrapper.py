"""Perturbations for a task that is made already."""

from __future__ import annotations

import dataclasses
from typing import Any

import gymnasium

from sb3_dreamer_urlb.envs.control_env import ControlEnv
from sb3_dreamer_urlb.envs.perturbations import LIMBS, Perturbations, make_perturbations
from sb3_dreamer_urlb.envs.perturbed_control import QUADRUPED_ARENAS, PerturbedControl


class PerturbationWrapper(gymnasium.Wrapper[Any, Any, Any, Any], gymnasium.utils.RecordConstructorArgs):
    """Puts any subset of the perturbations on any task of this package, whatever it is observed as::

        env = PerturbationWrapper(gymnasium.make("urlb/walker-run-v0"), action_delay=3, action_noise=0.1)

    It may be the innermost wrapper or not: what it does happens inside the environment, between its control steps, from the
    next reset on; an episode that is running is over.

    :param env: made by this package and not perturbed yet
    :param perturbations: :class:`~sb3_dreamer_urlb.envs.perturbations.Perturbations`, or their arguments by name
    :param arguments: the same, as keywords
    :raises ValueError: for environments of others, and naming what is wrong about the perturbations
    :raises gymnasium.error.ClosedEnvironmentError: if it was closed
    """

    def __init__(self, env: gymnasium.Env[Any, Any], perturbations: Perturbations | None = None, **arguments: Any):
        if perturbations is not None and arguments:
            raise ValueError(f"perturbations and {', '.join(arguments)} were given: expected one or the other")
        wanted = make_perturbations(perturbations if perturbations is not None else arguments)
        assert wanted is not None
        # By name, so that the wrapper's spec can be written as JSON.
        gymnasium.utils.RecordConstructorArgs.__init__(self, perturbations=dataclasses.asdict(wanted))
        gymnasium.Wrapper.__init__(self, env)
        if not isinstance(env.unwrapped, ControlEnv):
            raise ValueError(f"{env}: only the tasks of this package can be perturbed, not {type(env.unwrapped).__name__}")
        perturb(env.unwrapped, wanted)


def perturb(env: ControlEnv, perturbations: Perturbations) -> None:
    """Let an environment be stepped under perturbations, from its next reset.

    :param env: not perturbed yet
    :param perturbations: what to do
    :raises ValueError: if it is perturbed already, and for limbs that the body does not have
    """
    if env.perturbed is not None:
        raise ValueError(f"{env} is perturbed already, by {env.perturbed.perturbations}")
    if perturbations.limb(env.domain) is not None and env.domain == "quadruped" and env.task not in QUADRUPED_ARENAS:
        raise ValueError(f"{LIMBS[env.domain]}: {env.domain} has it in {', '.join(QUADRUPED_ARENAS)}, not {env.task}")
    env.perturb(PerturbedControl(env._control, perturbations, env.domain, env.task))
