"""What an environment's task is called: domain and task, and how it was changed, from its id and its own words."""

from __future__ import annotations

import re
from typing import Any

from stable_baselines3.common.vec_env import VecEnv

from sb3_dreamer_urlb.envs.facts import env_attribute
from sb3_dreamer_urlb.envs.registration import JACO_VARIANTS
from sb3_dreamer_urlb.envs.told import CLASS

#: domain of tasks that have none of their own
GYMNASIUM = "gymnasium"
_ID = re.compile(r"(?P<family>urlb|rwrl)/(?P<domain>[a-z]+)-(?P<task>[a-z_]+)(?:-(?P<change>[a-z]+))?-v\d+")


def columns_of_id(env_id: str) -> dict[str, str]:
    """What the id of an environment says.

    :param env_id: such as ``urlb/walker-run-v0``, ``rwrl/walker-walk-easy-v0``, ``urlb/jaco-reach_top_left-sparse-v0``
    :return: ``domain`` and ``task``, with ``perturbation`` (a level) or ``variant`` where there is one; of another id
        its name without the version as the task of the domain ``gymnasium``
    """
    found = _ID.fullmatch(env_id)
    if found is None:
        return {"domain": GYMNASIUM, "task": re.sub(r"-v\d+$", "", env_id)}
    columns = {"domain": found["domain"], "task": found["task"]}
    if found["change"]:
        columns["variant" if found["change"] in JACO_VARIANTS else "perturbation"] = found["change"]
    return columns


def task_columns(env: VecEnv) -> dict[str, str]:
    """As :func:`columns_of_id`, of an environment with or without an id.

    :param env: of which the first is asked
    """
    spec = env_attribute(env, "spec", None)
    columns = {} if spec is None else columns_of_id(spec.id)
    if columns.get("domain", GYMNASIUM) == GYMNASIUM:
        # An id without a domain of its own: what the environment says counts.
        given: dict[str, Any] = {} if spec is None else spec.kwargs
        said = {name: given.get(name, env_attribute(env, name, None)) for name in ("domain", "task")}
        columns |= {name: value for name, value in said.items() if isinstance(value, str) and value}
    columns.setdefault("domain", GYMNASIUM)
    if "task" not in columns:
        columns["task"] = env_attribute(env, CLASS, type(env.unwrapped).__name__)
    return columns


def task_of(env: VecEnv) -> str | None:
    """``<domain>-<task>``, whatever is changed about it; None where nothing but the name of a class would tell.

    :param env: of which the first is asked
    """
    columns = task_columns(env)
    nameless = columns["domain"] == GYMNASIUM and env_attribute(env, "spec", None) is None
    return None if nameless else f"{columns['domain']}-{columns['task']}"
