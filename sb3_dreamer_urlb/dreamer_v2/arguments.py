"""Checks of what users hand in: one clear error, before any time is spent."""

from __future__ import annotations

import inspect
import math
import os
from typing import TYPE_CHECKING, Any

from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.utils import check_for_correct_spaces
from stable_baselines3.common.vec_env import VecEnv

from sb3_dreamer_urlb.behavior.actor_critic import ACTOR_GRADIENTS, AUTO, REINFORCE
from sb3_dreamer_urlb.intrinsic import make_intrinsic_reward
from sb3_dreamer_urlb.learning.graphs import COMPILE
from sb3_dreamer_urlb.nn.precision import PRECISIONS
from sb3_dreamer_urlb.number_checks import check_dict, check_integer, is_finite_number, is_integer, is_number
from sb3_dreamer_urlb.phases import PHASES
from sb3_dreamer_urlb.planning import make_planner
from sb3_dreamer_urlb.replay import SequenceReplayBuffer
from sb3_dreamer_urlb.replay.sampling import BY_EPISODE
from sb3_dreamer_urlb.spaces.actions import make_actions

if TYPE_CHECKING:
    from sb3_dreamer_urlb.dreamer_v2 import DreamerV2

# smallest allowed value of each integer argument
INTEGERS = {
    "buffer_size": 1,
    "learning_starts": 0,
    "batch_size": 1,
    "batch_length": 2,
    "imagination_horizon": 2,
    "planner_delay": 0,
    "skill_selection_starts": 0,
    "target_update_interval": 1,
}
# open or closed ranges of each number: (low, low allowed, high, high allowed)
NUMBERS = {
    "gamma": (0.0, False, 1.0, True),
    "gae_lambda": (0.0, True, 1.0, True),
    "kl_balance": (0.0, True, 1.0, True),
    "free_nats": (0.0, True, math.inf, False),
    "kl_scale": (0.0, True, math.inf, False),
    "adam_eps": (0.0, False, math.inf, False),
    "max_grad_norm": (0.0, False, math.inf, True),
    "weight_decay": (0.0, True, 1.0, False),
}
#: arguments of the policy that the algorithm fills in itself
POLICY_ARGUMENTS_OF_THE_MODEL = {
    "self",
    "observation_space",
    "action_space",
    "lr_schedule",
    "gamma",
    "discount_head",
    "intrinsic",
    "explores",
    "planner",
    "planning",
    "precision",
    "compile",
}
#: after this many finished episodes that are all shorter than a sequence, waiting for a longer one is given up
SHORT_EPISODES = 50


def check(model: DreamerV2) -> None:
    """Everything that can be known to be wrong before the networks are built.

    :raises ValueError: naming the argument, its value and what was expected
    """
    _check_settings(model)
    for name, least in INTEGERS.items():
        check_integer(name, getattr(model, name), least)
    for name, (low, low_ok, high, high_ok) in NUMBERS.items():
        value = getattr(model, name)
        inside = is_number(value) and (low < value < high or (low_ok and value == low) or (high_ok and value == high))
        if not inside:
            bounds = f"{'[' if low_ok else '('}{low:g}, {high:g}{']' if high_ok else ')'}"
            raise ValueError(f"{name} must lie in {bounds}, got {value!r}.")
    frequency = model.train_freq[0] if isinstance(model.train_freq, tuple) else model.train_freq
    if not is_integer(frequency) or frequency < 1:
        raise ValueError(f"train_freq must be a positive integer, or such a one with its unit, got {model.train_freq!r}.")
    if not is_integer(model.gradient_steps) or model.gradient_steps < -1:
        raise ValueError(f"gradient_steps must be -1 or a non-negative integer, got {model.gradient_steps!r}.")
    if model.ent_coef is not None and not (is_finite_number(model.ent_coef) and model.ent_coef >= 0):
        raise ValueError(f"ent_coef must be a non-negative number or None, got {model.ent_coef!r}.")
    if model.batch_length > model.buffer_size:
        raise ValueError(f"batch_length={model.batch_length} must not exceed buffer_size={model.buffer_size}.")
    for name in ("learning_rate", "actor_learning_rate", "critic_learning_rate"):
        value = getattr(model, name)
        if not callable(value) and not (is_finite_number(value) and value >= 0):
            raise ValueError(f"{name} must be a non-negative number or a schedule, got {value!r}.")
    if model.discount_head is not None and not isinstance(model.discount_head, bool):
        raise ValueError(f"discount_head must be True, False or None, got {model.discount_head!r}.")
    if not isinstance(model.overlap, bool):
        raise ValueError(f"overlap must be True or False, got {model.overlap!r}.")
    if model.action_noise is not None and not isinstance(model.action_noise, ActionNoise):
        raise ValueError(f"action_noise must be an ActionNoise of Stable-Baselines3 or None, got {model.action_noise!r}.")
    _check_names(model)
    _check_policy_kwargs(model)
    _check_spaces(model)
    if model.env is not None:
        _check_episode_fits(model, model.env)


def _check_settings(model: DreamerV2) -> None:
    """What is not the algorithm's, but Stable-Baselines3's: it takes anything, and fails later."""
    check_integer("stats_window_size", model._stats_window_size, 1)
    if model.seed is not None and not (is_integer(model.seed) and 0 <= model.seed < 2**32):
        raise ValueError(f"seed must be an integer in [0, 2**32), or None, got {model.seed!r}.")
    if model.tensorboard_log is not None and not isinstance(model.tensorboard_log, str | os.PathLike):
        raise ValueError(f"tensorboard_log must be the path of a folder or None, got {model.tensorboard_log!r}.")
    for name in ("policy_kwargs", "replay_buffer_kwargs", "planner_kwargs"):
        check_dict(name, getattr(model, name))


def check_verbose(verbose: Any) -> None:
    """Before Stable-Baselines3 compares it with numbers.

    :raises ValueError: for anything but 0, 1 and 2
    """
    if not is_integer(verbose) or not 0 <= verbose <= 2:
        raise ValueError(f"verbose must be 0, 1 or 2, got {verbose!r}.")


def _check_names(model: DreamerV2) -> None:
    if model.precision not in PRECISIONS:
        raise ValueError(f"precision must be one of {PRECISIONS}, got {model.precision!r}.")
    if model.actor_gradient not in (AUTO, *ACTOR_GRADIENTS):
        raise ValueError(f"actor_gradient must be one of {(AUTO, *ACTOR_GRADIENTS)}, got {model.actor_gradient!r}.")
    if model.compile not in COMPILE:
        raise ValueError(f"compile must be one of {COMPILE}, got {model.compile!r}.")
    method = model.intrinsic_reward
    intrinsic = make_intrinsic_reward(method, model.intrinsic_kwargs)
    if intrinsic is not None:
        intrinsic.check(particles=(model.imagination_horizon + 1) * model.batch_size * model.batch_length)
    if method is None and PHASES[model.phase].explores:
        raise ValueError(
            f"A model in the phase {model.phase!r} needs an intrinsic_reward, got None: to move on to the task, "
            "load it as it is and call fine_tune()."
        )
    make_planner(model.planner, model.planner_kwargs, model.gae_lambda)
    buffer_class = model.replay_buffer_class
    if buffer_class is not None and not (isinstance(buffer_class, type) and issubclass(buffer_class, SequenceReplayBuffer)):
        raise ValueError(
            f"replay_buffer_class must be a subclass of SequenceReplayBuffer, got {buffer_class!r}: "
            "a world model learns from sequences, so SB3's transition buffers and HER do not apply."
        )


def _check_policy_kwargs(model: DreamerV2) -> None:
    known = set(inspect.signature(model.policy_class.__init__).parameters) - POLICY_ARGUMENTS_OF_THE_MODEL
    unknown = sorted(set(model.policy_kwargs) - known)
    if unknown:
        raise ValueError(f"Unknown policy_kwargs {unknown}; known are {sorted(known)}.")


def _check_spaces(model: DreamerV2) -> None:
    if getattr(model, "observation_space", None) is None:
        raise ValueError("DreamerV2 needs an environment: env is None.")
    normalize_images = model.policy_kwargs.get("normalize_images", True)
    model.policy_class.check_spaces(model.observation_space, model.action_space, normalize_images)
    if model.actor_gradient == REINFORCE and not make_actions(model.action_space).classes:
        # The density of a clamped action is not the normal's.
        raise ValueError(f"actor_gradient='reinforce' needs Discrete or MultiDiscrete actions, got {model.action_space}.")
    if model.action_noise is not None and make_actions(model.action_space).classes:
        raise ValueError(f"action_noise={model.action_noise!r} needs a Box action space, got {model.action_space}.")


def check_env(model: DreamerV2, env: VecEnv) -> None:
    """Whether a model can go on in another environment.

    :param model: with its spaces
    :param env: vectorised
    :raises AssertionError: for another number of environments, as SB3's ``set_env``
    :raises ValueError: for other spaces, or episodes shorter than a sequence
    """
    if env.num_envs != model.n_envs:
        raise AssertionError(
            f"The number of environments differs from the model's: {env.num_envs} != {model.n_envs}. "
            "To change it, load a snapshot with the new ones: DreamerV2.load(path, env=...)."
        )
    check_for_correct_spaces(env, model.observation_space, model.action_space)
    _check_episode_fits(model, env)


def _check_episode_fits(model: DreamerV2, env: VecEnv) -> None:
    if model.replay_buffer_kwargs.get("sampling", BY_EPISODE) != BY_EPISODE:
        return
    batch_length = model.batch_length
    steps = env_attribute(env, "max_episode_steps", None)
    if steps is None:
        steps = getattr(env_attribute(env, "spec", None), "max_episode_steps", None)
    # An episode has one row more than steps: the reset's.
    if steps is not None and steps + 1 < batch_length:
        raise ValueError(
            f"batch_length={batch_length} is longer than any episode: the environment ends them after {steps} steps."
        )


def check_episode_length(buffer: SequenceReplayBuffer) -> None:
    """Stop a run whose episodes are all too short to learn from.

    :raises ValueError: after ``SHORT_EPISODES`` of them
    """
    if buffer.sampling == BY_EPISODE and buffer.finished_count >= SHORT_EPISODES:
        raise ValueError(
            f"batch_length={buffer.batch_length} is longer than any of the first {buffer.finished_count} episodes "
            f"(the longest had {buffer.longest} rows): choose a smaller batch_length, or "
            "replay_buffer_kwargs={'sampling': 'rows'}."
        )


def env_attribute(env: VecEnv, name: str, default: Any) -> Any:
    """An attribute of the first environment, through all wrappers; ``default`` where there is none."""
    # Asking a SubprocVecEnv for an attribute that is not there would end its processes.
    return env.get_attr(name, indices=0)[0] if env.has_attr(name) else default


def check_load_keywords(algorithm: type[DreamerV2], kwargs: dict[str, Any]) -> None:
    """SB3 would silently set any keyword as an attribute.

    :raises TypeError: for a keyword that is no constructor argument, or one that only makes sense there
    """
    known = set(inspect.signature(algorithm.__init__).parameters) - {"self", "policy", "env", "preset", "_init_setup_model"}
    unknown = sorted(set(kwargs) - known)
    if unknown:
        raise TypeError(f"load() got unknown keywords {unknown}; known are {sorted(known)}.")
