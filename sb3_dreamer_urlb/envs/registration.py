"""The benchmark's tasks by name, and their gymnasium ids. Imports nothing heavy."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import gymnasium

from sb3_dreamer_urlb.envs.options import check_choice
from sb3_dreamer_urlb.envs.perturbations import LEVELS
from sb3_dreamer_urlb.unknown_names import did_you_mean

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

#: Name of the argument that tells an environment under which id it is made.
NAMED = "named"

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


#: id → what it says: ``domain`` and ``task``, and ``level`` if it is perturbed
_MEANT: dict[str, dict[str, str]] = {
    **{env_id(domain, task): {"domain": domain, "task": task} for domain, tasks in URLB_TASKS.items() for task in tasks},
    **{variant_id(task): {"domain": "jaco", "task": task} for task in JACO_VARIANT_TASKS},
    **{
        name: {"domain": domain, "task": "walk", "level": level}
        for domain in RWRL_DOMAINS
        for level, name in rwrl_ids(domain).items()
    },
}


def meant_by(name: str) -> dict[str, str]:
    """What an id of this package says: ``domain`` and ``task``, and ``level`` if it is perturbed. Empty for any other id.

    :param name: the id
    """
    return dict(_MEANT.get(name, {}))


def id_meaning(wanted: dict[str, str]) -> str | None:
    """The id that says this; None if there is none.

    :param wanted: as :func:`meant_by` gives it
    """
    return next((name for name, meant in _MEANT.items() if meant == wanted), None)


@contextmanager
def naming_near_ids(name: str) -> Iterator[None]:
    """Where Gymnasium does not know an id and has no near one in its namespace, its error names those of all.

    :param name: the id
    """
    try:
        yield
    except gymnasium.error.UnregisteredEnv as error:
        if "did you mean" not in str(error).lower():
            error.args = (str(error) + did_you_mean([name], gymnasium.registry),)
        raise


def register_envs() -> None:
    """Make the ids known to gymnasium: the twelve ``urlb/<domain>-<task>-v0``, the Jaco tasks' variants,
    ``rwrl/<domain>-walk-<level>-v0`` of the Real-World RL suite, and ``urlb/dm_control-v0`` for any other task of dm_control
    (``gymnasium.make("urlb/dm_control-v0", domain="cartpole", task="swingup")``).

    Entry points are strings, so that a spawned process can load them. No ``max_episode_steps``: dm_control truncates, and
    the environment tells its length in its own attribute of that name. May be called again.
    """
    for name in _MEANT:
        # Who is made is not told its id: so that options which contradict it are noticed, it is an argument.
        _register(name, "make_named_env", {**meant_by(name), NAMED: name})
    _register("urlb/dm_control-v0", "make_dmc_env", {})


def _register(name: str, function: str, kwargs: dict[str, str]) -> None:
    """Register one id, unless it is.

    :param name: the id
    :param function: of the module ``dmc``
    :param kwargs: its arguments
    """
    if name not in gymnasium.registry:
        gymnasium.register(name, entry_point=f"sb3_dreamer_urlb.envs.dmc:{function}", kwargs=kwargs)
