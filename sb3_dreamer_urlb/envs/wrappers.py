"""Through which wrappers a model sees its environment: whoever plays it elsewhere needs them, too."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import Any

import gymnasium
from gymnasium.envs.registration import EnvSpec
from gymnasium.wrappers import RecordEpisodeStatistics, RecordVideo
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper, VecMonitor, VecNormalize, VecTransposeImage

from sb3_dreamer_urlb.envs.facts import env_attribute
from sb3_dreamer_urlb.envs.faults import FaultGuard

#: change nothing that an agent sees or does
WATCHING = (Monitor, RecordEpisodeStatistics, RecordVideo, FaultGuard)
#: likewise; or the model puts them around itself
OF_THEMSELVES = (VecMonitor, VecNormalize, VecTransposeImage)


@dataclass(frozen=True)
class Around:
    """One wrapper.

    :param kind: module and name of its class
    :param kwargs: that it was made with, beside the environment; None where nobody recorded them
    """

    kind: str
    kwargs: dict[str, Any] | None


def put_around(env: VecEnv) -> list[Around]:
    """Those that neither ``gymnasium.make`` nor the model puts around by itself, and that change something; innermost first.

    :param env: vectorised; of what it holds, the spec tells
    """
    return [*_one_by_one(env_attribute(env, "spec", None)), *_vectorised(env)]


def can_be_put_around(env: VecEnv) -> bool:
    """Whether all of :func:`put_around` said what they were made with, and each is of one environment.

    :param env: vectorised
    """
    return not _vectorised(env) and all(each.kwargs is not None for each in _one_by_one(env_attribute(env, "spec", None)))


def with_the_wrappers_of(env: VecEnv, one: gymnasium.Env[Any, Any]) -> gymnasium.Env[Any, Any]:
    """Put those of an environment around another one of its id.

    :param env: vectorised, of which :func:`can_be_put_around` holds
    :param one: of its id, as ``gymnasium.make`` gives it
    """
    for each in _one_by_one(env_attribute(env, "spec", None)):
        module, _, name = each.kind.rpartition(".")
        one = getattr(import_module(module), name)(one, **(each.kwargs or {}))
    return one


def _one_by_one(spec: EnvSpec | None) -> list[Around]:
    if spec is None:
        return []
    registered = gymnasium.registry.get(spec.id)
    usual = len(registered.additional_wrappers) if registered is not None else 0
    found = [Around(its.entry_point.replace(":", "."), its.kwargs) for its in spec.additional_wrappers[usual:]]
    watching = {_named(kind) for kind in WATCHING}
    return [each for each in found if each.kind not in watching]


def _vectorised(env: VecEnv) -> list[Around]:
    found = []
    while isinstance(env, VecEnvWrapper):
        if not isinstance(env, OF_THEMSELVES):
            found.append(Around(_named(type(env)), None))
        env = env.venv
    return found[::-1]


def _named(kind: type) -> str:
    return f"{kind.__module__}.{kind.__qualname__}"
