"""Recording an agent at work, in an environment like the one that it learns in."""

from __future__ import annotations

import copy
import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import gymnasium
import numpy as np
import torch as th
from gymnasium.error import DependencyNotInstalled
from stable_baselines3.common.env_util import is_wrapped
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_dreamer_urlb.algorithm.environment_checks import given_env
from sb3_dreamer_urlb.envs.facts import env_attribute
from sb3_dreamer_urlb.envs.info_keys import TERMINAL
from sb3_dreamer_urlb.envs.wrappers import can_be_put_around, put_around, with_the_wrappers_of
from sb3_dreamer_urlb.evaluation.open_loop import has_image, pictures_in
from sb3_dreamer_urlb.spaces.comparing import check_same_spaces
from sb3_dreamer_urlb.types import Observation

if TYPE_CHECKING:
    from sb3_dreamer_urlb.algorithm.agent_algorithm import AgentAlgorithm

#: frames a second where the environment does not say
DEFAULT_FPS = 20.0


@dataclass
class Recording:
    """An episode, or its beginning.

    :param observations: as the policy took them, (steps + 1, …)
    :param actions: as the environment received them, (steps, …)
    :param frames: what there was to see, uint8 (height, width, 3) for each observation but the last
    :param fps: frames a second of the environment's time
    """

    observations: Observation
    actions: np.ndarray
    frames: list[np.ndarray]
    fps: float


def env_to_play_in(model: AgentAlgorithm, env: GymEnv | str | None = None, argument: str = "env") -> VecEnv:
    """An environment as the model takes it: vectorised, normalised with the model's own statistics.

    :param model: that is to play
    :param env: VecEnv of one environment, used as it is; an environment or its id; None makes another one of the same id,
        arguments and, where all of them recorded their own, wrappers as the model's first
    :param argument: what the caller's user calls ``env``, for messages
    :raises ValueError: if it does not fit the model, or no environment can be made
    """
    origin = ""
    if isinstance(env, VecEnv):
        vec_env = env
    else:
        if env is None:
            env = _same_again(model, argument)
            origin = f" It lacks the wrappers of the training environment: give {argument}."
        one: Any = given_env(env, argument)
        monitored = one if is_wrapped(one, Monitor) else Monitor(one)
        vec_env = _normalized_alike(model, DummyVecEnv([lambda: monitored]))
    vec_env = model._wrap_env(vec_env, verbose=0)
    if vec_env.num_envs != 1:
        raise ValueError(f"One environment is needed to play in, got {vec_env.num_envs}.")
    try:
        check_same_spaces(vec_env, model)
    except ValueError as error:
        raise ValueError(f"The environment to play in does not fit the model: {error}{origin}") from error
    return vec_env


def _same_again(model: AgentAlgorithm, argument: str) -> gymnasium.Env[Any, Any]:
    train_env = model.get_env()
    spec = None if train_env is None else env_attribute(train_env, "spec", None)
    if train_env is None or spec is None:
        raise ValueError(f"Another environment like the model's cannot be made, as it has no registered id: give {argument}.")
    kwargs = {**spec.kwargs}
    around = put_around(train_env)
    if not can_be_put_around(train_env):
        names = ", ".join(each.kind.rpartition(".")[2] for each in around)
        warnings.warn(f"An environment like the model's is made to play in, without its wrappers ({names}): give {argument}.")
    if "rgb_array" in env_attribute(train_env, "metadata", {}).get("render_modes", ()):
        kwargs["render_mode"] = "rgb_array"
    one = gymnasium.make(spec.id, max_episode_steps=spec.max_episode_steps, **kwargs)
    return with_the_wrappers_of(train_env, one) if can_be_put_around(train_env) else one


def _normalized_alike(model: AgentAlgorithm, env: VecEnv) -> VecEnv:
    own = model.get_vec_normalize_env()
    if own is None:
        return env
    settings = {name: getattr(own, name) for name in ("norm_obs", "norm_obs_keys", "clip_obs", "epsilon")}
    return VecNormalize(env, training=False, norm_reward=False, **settings)


def copy_statistics(model: AgentAlgorithm, env: VecEnv) -> None:
    """Give an environment the statistics that the model's observations are normalised with at present.

    :param model: that is to play
    :param env: to play in
    """
    own, other = model.get_vec_normalize_env(), unwrap_vec_normalize(env)
    if own is not None and other is not None and own is not other:
        if own.norm_obs:
            other.obs_rms = copy.deepcopy(own.obs_rms)
        other.ret_rms = copy.deepcopy(own.ret_rms)


def check_visible(model: AgentAlgorithm, env: VecEnv) -> None:
    """
    :param model: that is to play
    :param env: to play in
    :raises ValueError: if there is nothing to make pictures of
    """
    if env.render_mode != "rgb_array" and not has_image(model.policy.observations):
        raise ValueError(
            f"There is nothing to film: the observations are no images, and the environment's render_mode is "
            f"{env.render_mode!r}, not 'rgb_array'."
        )


def check_drawn(model: AgentAlgorithm, env: VecEnv) -> None:
    """Draw once: whether an environment can, it only says when it is asked to. Resets it.

    :param model: that is to play
    :param env: to play in
    :raises ValueError: if there is nothing to make pictures of, or what draws them is not installed
    """
    check_visible(model, env)
    if env.render_mode == "rgb_array":
        env.reset()
        _rendered(env)


@th.no_grad()
def record(model: AgentAlgorithm, env: VecEnv, max_steps: int, deterministic: bool = True) -> Recording:
    """Play one episode with the model's memory threaded through, with the planner if it is on.

    :param model: that plays; it is not changed
    :param env: see :func:`env_to_play_in`
    :param max_steps: agent steps at most
    :param deterministic: handed to ``predict``
    :raises ValueError: if there is nothing to make pictures of, or what draws them is not installed
    """
    check_visible(model, env)
    copy_statistics(model, env)
    observation: Any = env.reset()
    observations, frames = [observation], []
    actions: list[np.ndarray] = []
    state: tuple[np.ndarray, ...] | None = None
    start = np.ones(1, bool)
    while len(actions) < max_steps and not (actions and start[0]):
        frames.append(_picture(model, env, observation))
        action, state = model.predict(observation, state, start, deterministic)
        observation, _, start, infos = env.step(action)
        last = infos[0].get(TERMINAL) if start[0] else None
        observations.append(observation if last is None else _batch_of_one(last))
        actions.append(action[0])
    fps = env_attribute(env, "metadata", {}).get("render_fps") or DEFAULT_FPS
    return Recording(_stacked(observations), np.stack(actions), frames, float(fps))


def _picture(model: AgentAlgorithm, env: VecEnv, observation: Any) -> np.ndarray:
    if env.render_mode == "rgb_array":
        return _rendered(env)
    policy = model.policy
    shown: np.ndarray = pictures_in(policy.observations, policy.observations.preprocess(_stacked([observation])))[0]
    return shown


def _rendered(env: VecEnv) -> np.ndarray:
    try:
        rendered = env.get_images()[0]
    except DependencyNotInstalled as error:  # pygame, say
        raise ValueError(f"The environment cannot be filmed: {error}") from error
    assert rendered is not None
    return np.asarray(rendered, np.uint8)


def _batch_of_one(observation: np.ndarray | dict[str, np.ndarray]) -> Any:
    if isinstance(observation, dict):
        return {name: part[None] for name, part in observation.items()}
    return np.asarray(observation)[None]


def _stacked(observations: list[Any]) -> Observation:
    if isinstance(observations[0], dict):
        return {name: th.as_tensor(np.concatenate([seen[name] for seen in observations])) for name in observations[0]}
    return th.as_tensor(np.concatenate(observations))
