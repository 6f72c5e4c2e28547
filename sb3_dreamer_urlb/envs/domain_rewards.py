"""What each task of a domain would pay for the same state: rewards of dm_control's own task objects."""

from __future__ import annotations

from typing import Any

from sb3_dreamer_urlb.envs.registration import URLB_TASKS

#: whose tasks share a body and a world; Jaco's differ in where the target stands, so each has physics of its own
DOMAINS = ("walker", "quadruped")
#: key of ``info``: the reward of each task of the domain, by name
KEY = "domain_rewards"


def check_domain(domain: str, task: str) -> None:
    """
    :param domain: of an environment
    :param task: its task
    :raises ValueError: if its rewards cannot be told from one simulation
    """
    if domain not in DOMAINS or task not in URLB_TASKS[domain]:
        raise ValueError(
            f"domain_rewards=True: expected a task of the benchmark in {' or '.join(DOMAINS)}, whose tasks share one body and "
            f"world; got {domain}-{task}"
        )


class DomainRewards:
    """Rewards of the benchmark's tasks in one domain.

    :param domain: of ``DOMAINS``
    """

    def __init__(self, domain: str):
        from sb3_dreamer_urlb.envs.urlb_tasks import make_suite_task

        self._tasks: dict[str, Any] = {task: make_suite_task(domain, task).task for task in URLB_TASKS[domain]}

    def __call__(self, physics: Any) -> dict[str, float]:
        """
        :param physics: of any task in the domain
        :return: task → reward of the present control step
        """
        return {name: float(task.get_reward(physics)) for name, task in self._tasks.items()}
