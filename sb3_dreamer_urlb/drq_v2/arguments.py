"""Checks of DrQv2's arguments: one clear error, before any time is spent."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

from sb3_dreamer_urlb.algorithm import checks
from sb3_dreamer_urlb.drq_v2.noise import check_noise_std
from sb3_dreamer_urlb.drq_v2.policies import DrQPolicy
from sb3_dreamer_urlb.intrinsic import TransitionReward, make_intrinsic_reward
from sb3_dreamer_urlb.number_checks import check_integer, check_switch
from sb3_dreamer_urlb.replay.n_step import NStepFrameReplayBuffer
from sb3_dreamer_urlb.snapshots.saved_algorithm import SavedAlgorithm

# smallest allowed value of each integer argument
INTEGERS = {"buffer_size": 1, "learning_starts": 0, "batch_size": 1, "n_steps": 1}
# open or closed ranges of each number
NUMBERS: dict[str, checks.Range] = {
    "gamma": (0.0, False, 1.0, True),
    "tau": (0.0, False, 1.0, True),
    "noise_clip": (0.0, True, math.inf, False),
    "adam_eps": (0.0, False, math.inf, False),
}
#: arguments of the policy that the algorithm fills in itself
POLICY_ARGUMENTS_OF_THE_MODEL = {
    "self", "observation_space", "action_space", "lr_schedule", "frame_stack", "noise_std", "intrinsic",
}  # fmt: skip

#: arguments of the replay that it fills in, too
REPLAY_ARGUMENTS_OF_THE_MODEL = {"frame_stack", "n_steps", "gamma", "sampling"}
FILLED_IN = frozenset(POLICY_ARGUMENTS_OF_THE_MODEL | REPLAY_ARGUMENTS_OF_THE_MODEL | checks.REPLAY_ARGUMENTS_OF_THE_MODEL)
#: what can be assigned on a model, see :attr:`~sb3_dreamer_urlb.algorithm.assignable_arguments.AssignableArguments.assignable`
ASSIGNABLE = frozenset(
    {
        "learning_rate", "adam_eps", "batch_size", "tau", "gamma", "noise_std", "noise_clip",
        "learning_starts", "train_freq", "gradient_steps", "action_noise", "overlap", "verbose", "tensorboard_log",
    }
)  # fmt: skip
#: what networks are built with, and what decides on their training in fine-tuning
OF_THE_NETWORKS = frozenset({"frame_stack", "intrinsic_reward", "intrinsic_kwargs", "policy_kwargs", "preset"})
BEFORE_FINE_TUNING = frozenset({"freeze_encoder"})


def check(model: SavedAlgorithm) -> None:
    """Everything that can be known to be wrong before the networks are built.

    :param model: with its arguments and, if it has an environment, with its spaces
    :raises ValueError: naming the argument, its value and what was expected
    """
    given = SimpleNamespace(**model.arguments())
    checks.check_settings(model)
    for name, least in INTEGERS.items():
        check_integer(name, getattr(given, name), least)
    if given.frame_stack is not None:
        check_integer("frame_stack", given.frame_stack, 1)
    for name, bounds in NUMBERS.items():
        checks.check_number(name, getattr(given, name), bounds)
    checks.check_schedule_of_updates(model)
    checks.check_rate("learning_rate", given.learning_rate)
    check_noise_std(given.noise_std)
    for name in ("overlap", "freeze_encoder"):
        check_switch(name, getattr(given, name))
    checks.check_noise(model)
    checks.check_forms(given.precision, given.compile)
    make_intrinsic_reward(given.intrinsic_reward, given.intrinsic_kwargs, TransitionReward)
    checks.check_method(given.intrinsic_reward, model.phase)
    checks.check_policy(model, DrQPolicy, POLICY_ARGUMENTS_OF_THE_MODEL)
    checks.check_replay(
        model,
        NStepFrameReplayBuffer,
        REPLAY_ARGUMENTS_OF_THE_MODEL,
        "it stacks frames and sums n-step returns when it is sampled",
    )
    if getattr(model, "observation_space", None) is None:
        raise ValueError("DrQv2 needs an environment: env is None.")
    kind: Any = model.policy_class
    kind.check_spaces(model.observation_space, model.action_space, given.policy_kwargs.get("normalize_images", True))
    rows = given.n_steps + (kind.usual_frame_stack if given.frame_stack is None else given.frame_stack)
    if rows > given.buffer_size:
        raise ValueError(f"buffer_size={given.buffer_size} must not be smaller than frame_stack + n_steps, {rows} rows.")
