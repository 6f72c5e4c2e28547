"""The benchmark's tasks by name, and their gymnasium ids. Imports nothing heavy."""

from __future__ import annotations

import gymnasium

from sb3_dreamer_urlb.envs.options import check_choice
from sb3_dreamer_urlb.envs.perturbations import LEVELS

#: The three domains with four tasks each (URLB, Laskin et al. 2021).
URLB_TASKS: dict[str, tuple[str, ...]] = {
    "walker": ("stand", "walk", "run", "flip"),
    "quadruped": ("stand", "walk", "run", "jump"),
    "jaco": ("reach_top_left", "reach_top_right", "reach_bottom_left", "reach_bottom_right"),
}

#: Bodies that the Real-World RL suite's levels are of; its task is walk.
RWRL_DOMAINS = ("walker", "quadruped")

#: What a Jaco task's name may end with: the target cannot move the reward; a smaller and a larger rewarded area.
JACO_VARIANTS = ("fixed", "sparse", "dense")

#: The Jaco tasks' variants by name, of the paper's extended analysis.
JACO_VARIANT_TASKS = tuple(f"{task}-{variant}" for task in URLB_TASKS["jaco"] for variant in JACO_VARIANTS)

DOMAINS: tuple[str, ...] = tuple(URLB_TASKS)

#: The task whose environment an agent is pre-trained in, one a domain; its reward is not used.
PRIMAL_TASK: dict[str, str] = {"walker": "stand", "quadruped": "walk", "jaco": "reach_top_left"}


def env_id(domain: str, task: str) -> str:
    """The gymnasium id of one of the benchmark's tasks, such as ``urlb/walker-run-v0``.

    :param domain: a domain of ``URLB_TASKS``
    :param task: a task of that domain
    :raises ValueError: if there is no such task
    """
    check_urlb_task(domain, task)
    return f"urlb/{domain}-{task}-v0"


def check_urlb_task(domain: str, task: str) -> None:
    """:raises ValueError: if this is not one of the benchmark's tasks; it lists those there are"""
    check_choice("domain", domain, DOMAINS)
    check_choice("task", task, URLB_TASKS[domain], f"{domain} has")


def variant_id(task: str) -> str:
    """The gymnasium id of one of ``JACO_VARIANT_TASKS``.

    :param task: its name
    """
    return f"urlb/jaco-{task}-v0"


def rwrl_ids(domain: str) -> dict[str, str]:
    """Level → gymnasium id of the Real-World RL suite's tasks; empty for bodies that it does not perturb here.

    :param domain: any
    """
    return {level: f"rwrl/{domain}-walk-{level}-v0" for level in LEVELS} if domain in RWRL_DOMAINS else {}


def register_envs() -> None:
    """Make the ids known to gymnasium: the twelve ``urlb/<domain>-<task>-v0``, the Jaco tasks' variants,
    ``rwrl/<domain>-walk-<level>-v0`` of the Real-World RL suite, and ``urlb/dm_control-v0`` for any other task of dm_control
    (``gymnasium.make("urlb/dm_control-v0", domain="cartpole", task="swingup")``).

    Entry points are strings, so that a spawned process can load them. No ``max_episode_steps``: dm_control truncates, and
    the environment tells its length in its own attribute of that name. May be called again.
    """
    for domain, tasks in URLB_TASKS.items():
        for task in tasks:
            _register(env_id(domain, task), "make_urlb_env", {"domain": domain, "task": task})
    _register("urlb/dm_control-v0", "make_dmc_env", {})
    for task in JACO_VARIANT_TASKS:
        _register(variant_id(task), "make_dmc_env", {"domain": "jaco", "task": task})
    for domain in RWRL_DOMAINS:
        for level, name in rwrl_ids(domain).items():
            _register(name, "make_rwrl_env", {"domain": domain, "task": "walk", "level": level})


def _register(name: str, function: str, kwargs: dict[str, str]) -> None:
    """Register one id, unless it is.

    :param name: the id
    :param function: of the module ``dmc``
    :param kwargs: its arguments
    """
    if name not in gymnasium.registry:
        gymnasium.register(name, entry_point=f"sb3_dreamer_urlb.envs.dmc:{function}", kwargs=kwargs)
