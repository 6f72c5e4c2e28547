"""List the environments that this package registers: length, actions, reward, what each is for."""

from __future__ import annotations

import argparse
from typing import Any, NamedTuple

HELP = "list the registered environments"

#: control steps of an episode, and size of an action, by domain
_BODIES = {"walker": (1000, 6), "quadruped": (1000, 12), "jaco": (250, 9)}
_REWARDS = {
    "stand": "upright",
    "walk": "upright, forwards",
    "run": "upright, forwards fast",
    "flip": "upright, spinning forwards",
    "jump": "upright, high up",
}


class Task(NamedTuple):
    """One line of the list.

    :param id: of gymnasium
    :param domain: the body
    :param steps: agent steps of an episode, at the default action repeat of 2
    :param frames: control steps of an episode
    :param actions: numbers in an action
    :param reward: what earns it; at most 1 a control step
    :param purpose: what the task is for
    """

    id: str
    domain: str
    steps: int
    frames: int
    actions: int
    reward: str
    purpose: str


def tasks() -> list[Task]:
    """All registered ids but ``urlb/dm_control-v0``, which has any length and any action."""
    from sb3_dreamer_urlb.envs import registration
    from sb3_dreamer_urlb.envs.registration import JACO_VARIANT_TASKS, PRIMAL_TASK, URLB_TASKS, env_id

    found = []
    for domain, names in URLB_TASKS.items():
        for name in names:
            primal = name == PRIMAL_TASK[domain]
            found.append(
                _task(env_id(domain, name), domain, name, "pre-training, and fine-tuning" if primal else "fine-tuning")
            )
    purposes = {
        "fixed": "a target that cannot move",
        "sparse": "sparsity: smaller rewarded area",
        "dense": "sparsity: larger rewarded area",
    }
    for name in JACO_VARIANT_TASKS:
        found.append(_task(registration.variant_id(name), "jaco", name, purposes[name.partition("-")[2]]))
    for domain in URLB_TASKS:
        for level, its_id in registration.rwrl_ids(domain).items():
            found.append(_task(its_id, domain, "walk", f"robustness: perturbed, {level}"))
    return found


def _task(name: str, domain: str, task: str, purpose: str) -> Task:
    frames, actions = _BODIES[domain]
    reward = "hand at the target" if domain == "jaco" else _REWARDS[task]
    return Task(name, domain, frames // 2, frames, actions, reward, purpose)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """
    :param parser: of this command
    """
    parser.add_argument("--domain", choices=sorted(_BODIES), help="only of this body")


def run(options: dict[str, Any]) -> int:
    """
    :param options: of the command line, those that were given
    :return: exit status
    """
    rows = [Task._fields, *(tuple(map(str, task)) for task in tasks() if task.domain == options.get("domain", task.domain))]
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    for row in rows:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())
    print("\nAny other task of dm_control: gymnasium.make('urlb/dm_control-v0', domain=..., task=...).")
    print("All of them also from states: gymnasium.make(id, observation='state').")
    return 0
