"""Where rl_zoo3 pre-trains: in the environment of the domain's primal task, whatever task comes after it (paper §4).

Otherwise the agent would have seen the task's own world before: jaco's brick at its place, the floor of quadruped run.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

from stable_baselines3.common.vec_env import VecEnv

from sb3_dreamer_urlb.callbacks.phase_switch import PhaseSwitchCallback
from sb3_dreamer_urlb.envs import PRIMAL_TASK, env_id
from sb3_dreamer_urlb.envs.registration import meant_by
from sb3_dreamer_urlb.runs.run_folder import PRETRAINING_LOGS

#: values of the key ``pretrain_env``: the primal task's environment, or the one that is fine-tuned in
PRIMAL, SAME = CHOICES = ("primal", "same")

#: arguments of an environment that perturb it, which nobody is pre-trained in
PERTURBING = ("perturbations", "level", "hard_thigh", "keep_buffers")


def primal_id(name: str) -> str | None:
    """The id of the environment in which an agent for a task is pre-trained; None for tasks that have none.

    Perturbed tasks and the variants of a task have their body's, which is neither perturbed nor changed.

    :param name: the task's id
    """
    domain = meant_by(name).get("domain")
    return None if domain is None else env_id(domain, PRIMAL_TASK[domain])


def make_envs(make: Callable[[], VecEnv], manager: Any) -> VecEnv:
    """The environments in which a run begins. Where they are not the task's, the switch of phases gets those.

    What perturbs the task is left out of the arguments that pre-training's environments get.

    :param make: makes environments of ``manager.env_name``, whose episodes Monitor writes to ``manager.save_path``
    :param manager: of rl_zoo3, with its callbacks
    """
    primal = primal_id(manager.env_name.gym_id)
    switches = [one for one in manager.callbacks if isinstance(one, PhaseSwitchCallback) and one.env is None]
    if (
        not switches
        or primal is None
        or (primal == manager.env_name.gym_id and not set(PERTURBING) & set(manager.env_kwargs or {}))
        or manager.optimize_hyperparameters
        or manager.pretrain_env == SAME
    ):
        return make()
    print(f"Pre-training in {primal}, fine-tuning in {manager.env_name.gym_id} (pretrain_env: {SAME} stays in the latter).")
    for switch in switches:
        switch.env, switch.closes_pretraining = make(), True
    there = type(manager.env_name)(primal)
    kwargs = {name: value for name, value in (manager.env_kwargs or {}).items() if name not in PERTURBING}
    with mock.patch.multiple(
        manager, env_name=there, env_kwargs=kwargs, save_path=str(Path(manager.save_path) / PRETRAINING_LOGS)
    ):
        return make()
