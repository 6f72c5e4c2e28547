"""Checks of DreamerV2's arguments: one clear error, before any time is spent."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_dreamer_urlb.algorithm import checks
from sb3_dreamer_urlb.behavior.actor_critic import ACTOR_GRADIENTS, AUTO, REINFORCE
from sb3_dreamer_urlb.dreamer_v2.policies import DreamerPolicy
from sb3_dreamer_urlb.envs.facts import steps_an_episode
from sb3_dreamer_urlb.intrinsic import make_intrinsic_reward
from sb3_dreamer_urlb.number_checks import check_choice, check_dict, check_integer, check_switch, is_finite_number
from sb3_dreamer_urlb.planning import make_planner
from sb3_dreamer_urlb.replay import SequenceReplayBuffer
from sb3_dreamer_urlb.replay.sampling import BY_EPISODE
from sb3_dreamer_urlb.snapshots.saved_algorithm import SavedAlgorithm
from sb3_dreamer_urlb.spaces.actions import make_actions

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
# open or closed ranges of each number
NUMBERS: dict[str, checks.Range] = {
    "gamma": (0.0, False, 1.0, True),
    "gae_lambda": (0.0, True, 1.0, True),
    "kl_balance": (0.0, True, 1.0, True),
    "free_nats": (0.0, True, math.inf, False),
    "kl_scale": (0.0, True, math.inf, False),
    "adam_eps": (0.0, False, math.inf, False),
    "max_grad_norm": (0.0, False, math.inf, True),
    "weight_decay": (0.0, True, 1.0, False),
}
#: warm-ups: uniform in the action space, or beyond it, so that most numbers end at its bounds
UNIFORM, SATURATED = WARMUPS = ("uniform", "saturated")
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
    "task_reward",
    "planner",
    "planning",
    "precision",
    "compile",
}
FILLED_IN = frozenset(POLICY_ARGUMENTS_OF_THE_MODEL | checks.REPLAY_ARGUMENTS_OF_THE_MODEL)
#: what can be assigned on a model, see :attr:`~sb3_dreamer_urlb.algorithm.assignable_arguments.AssignableArguments.assignable`
ASSIGNABLE = frozenset(
    {
        "learning_rate", "actor_learning_rate", "critic_learning_rate", "adam_eps", "max_grad_norm", "weight_decay",
        "batch_size", "imagination_horizon", "gamma", "gae_lambda", "ent_coef", "free_nats", "kl_balance", "kl_scale",
        "target_update_interval", "learning_starts", "train_freq", "gradient_steps", "skill_selection_starts",
        "planner", "planner_kwargs", "planner_delay", "action_noise", "overlap", "verbose", "tensorboard_log",
    }
)  # fmt: skip
#: what networks are built with, and what decides on their training in fine-tuning
OF_THE_NETWORKS = frozenset(
    {"discount_head", "intrinsic_reward", "intrinsic_kwargs", "learn_task_reward", "policy_kwargs", "preset"}
)
BEFORE_FINE_TUNING = frozenset({"freeze_decoder"})
#: after this many finished episodes that are all shorter than a sequence, waiting for a longer one is given up
SHORT_EPISODES = 50


def check(model: SavedAlgorithm) -> None:
    """Everything that can be known to be wrong before the networks are built.

    :param model: with its arguments and, if it has an environment, with its spaces
    :raises ValueError: naming the argument, its value and what was expected
    """
    given = SimpleNamespace(**model.arguments())
    checks.check_settings(model)
    check_dict("planner_kwargs", given.planner_kwargs)
    for name, least in INTEGERS.items():
        check_integer(name, getattr(given, name), least)
    for name, bounds in NUMBERS.items():
        checks.check_number(name, getattr(given, name), bounds)
    checks.check_schedule_of_updates(model)
    if given.ent_coef is not None and not (is_finite_number(given.ent_coef) and given.ent_coef >= 0):
        raise ValueError(f"ent_coef must be a non-negative number or None, got {given.ent_coef!r}.")
    if given.batch_length > given.buffer_size:
        raise ValueError(f"batch_length={given.batch_length} must not exceed buffer_size={given.buffer_size}.")
    for name in ("learning_rate", "actor_learning_rate", "critic_learning_rate"):
        checks.check_rate(name, getattr(given, name))
    if given.discount_head is not None and not isinstance(given.discount_head, bool):
        raise ValueError(f"discount_head must be True, False or None, got {given.discount_head!r}.")
    for name in ("overlap", "reward_trains_model", "freeze_decoder"):
        check_switch(name, getattr(given, name))
    _check_tasks(given.learn_task_reward)
    checks.check_noise(model)
    _check_names(given, model.phase)
    checks.check_policy(model, DreamerPolicy, POLICY_ARGUMENTS_OF_THE_MODEL)
    checks.check_replay(
        model,
        SequenceReplayBuffer,
        set(),
        "a world model learns from sequences, so SB3's transition buffers and HER do not apply",
    )
    _check_spaces(given, model)
    if model.env is not None:
        check_episodes_fit(given.batch_length, model.replay_buffer_kwargs, model.env)


def _check_tasks(tasks: Any) -> None:
    names = isinstance(tasks, list | tuple) and tasks and all(isinstance(name, str) and name.isidentifier() for name in tasks)
    if not (isinstance(tasks, bool) or (names and len(set(tasks)) == len(tasks))):
        raise ValueError(f"learn_task_reward must be True, False, or a list of names of tasks, each once, got {tasks!r}.")


def check_tasks_are_told(tasks: Sequence[str], env: VecEnv) -> None:
    """Whether an environment lets the rewards of several tasks be learnt, as far as it can be known before it steps.

    :param tasks: names
    :param env: to pre-train in
    :raises ValueError: if it normalises rewards: the others' have statistics of their own
    """
    normalizer = unwrap_vec_normalize(env)
    if tasks and normalizer is not None and normalizer.norm_reward:
        raise ValueError(
            f"learn_task_reward={list(tasks)!r} learns rewards as they are: wrap the environment in "
            "VecNormalize(norm_reward=False)."
        )


def _check_names(given: SimpleNamespace, phase: str) -> None:
    checks.check_forms(given.precision, given.compile)
    check_choice("actor_gradient", given.actor_gradient, (AUTO, *ACTOR_GRADIENTS))
    check_choice("warmup_actions", given.warmup_actions, WARMUPS)
    method = given.intrinsic_reward
    intrinsic = make_intrinsic_reward(method, given.intrinsic_kwargs)
    if intrinsic is not None:
        intrinsic.check(particles=(given.imagination_horizon + 1) * given.batch_size * given.batch_length)
    checks.check_method(method, phase)
    for name in ("learn_task_reward", "freeze_decoder"):
        if getattr(given, name) and method is None:
            raise ValueError(f"{name}={getattr(given, name)!r} needs a pre-training, got intrinsic_reward=None.")
    make_planner(given.planner, given.planner_kwargs, given.gae_lambda, classes=None)


def _check_spaces(given: SimpleNamespace, model: SavedAlgorithm) -> None:
    if getattr(model, "observation_space", None) is None:
        raise ValueError("DreamerV2 needs an environment: env is None.")
    kind: Any = model.policy_class
    normalize_images = given.policy_kwargs.get("normalize_images", True)
    kind.check_spaces(model.observation_space, model.action_space, normalize_images)
    if given.actor_gradient == REINFORCE and not make_actions(model.action_space).classes:
        # The density of a clamped action is not the normal's.
        raise ValueError(f"actor_gradient='reinforce' needs Discrete or MultiDiscrete actions, got {model.action_space}.")
    if given.warmup_actions == SATURATED and make_actions(model.action_space).classes:
        raise ValueError(f"warmup_actions={SATURATED!r} needs a Box action space, got {model.action_space}.")
    if given.action_noise is not None and make_actions(model.action_space).classes:
        raise ValueError(f"action_noise={given.action_noise!r} needs a Box action space, got {model.action_space}.")


def check_episodes_fit(batch_length: int, replay_buffer_kwargs: dict[str, Any], env: VecEnv) -> None:
    """Whether an environment's episodes are long enough for sequences, as far as it tells.

    :param batch_length: T
    :param replay_buffer_kwargs: how sequences are drawn
    :param env: vectorised
    :raises ValueError: if no episode can be
    """
    if replay_buffer_kwargs.get("sampling", BY_EPISODE) != BY_EPISODE:
        return
    steps = steps_an_episode(env)
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
