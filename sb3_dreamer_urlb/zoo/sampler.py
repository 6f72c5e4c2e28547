"""What rl_zoo3's ``-optimize`` tries. A trial that no longer learns is pruned (``NumericalFaultError``)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import optuna


def sample_dreamer_v2_params(
    trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """Constructor arguments of DreamerV2 for one trial: speed of learning, data, and how the actor is kept curious.

    Sizes of the networks and of the planner are left to the configuration: larger ones are better, and slower.

    :param trial: Optuna's
    :param n_actions: not used
    :param n_envs: updates follow the number of environments, so that all trials learn equally often
    :param additional_args: not used
    """
    trial.suggest_float("learning_rate", 1e-4, 2e-3, log=True)
    trial.suggest_float("actor_learning_rate", 2e-5, 1e-3, log=True)
    trial.suggest_float("critic_learning_rate", 2e-5, 1e-3, log=True)
    trial.suggest_categorical("train_freq", [2, 5, 10])
    trial.suggest_categorical("batch_size", [8, 16, 32, 50])
    trial.suggest_categorical("batch_length", [16, 32, 50])
    trial.suggest_categorical("imagination_horizon", [10, 15, 20])
    trial.suggest_float("ent_coef", 1e-5, 1e-2, log=True)
    trial.suggest_float("free_nats", 0.1, 3.0, log=True)
    trial.suggest_float("kl_balance", 0.5, 0.95)
    return convert_params(_learning_as_often(trial, n_envs))


def sample_drq_v2_params(trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """Constructor arguments of DrQv2 for one trial: speed of learning, data, and noise.

    :param trial: Optuna's
    :param n_actions: not used
    :param n_envs: updates follow the number of environments, so that all trials learn equally often
    :param additional_args: not used
    """
    trial.suggest_float("learning_rate", 3e-5, 1e-3, log=True)
    trial.suggest_categorical("batch_size", [64, 128, 256])
    trial.suggest_categorical("train_freq", [1, 2, 4])
    trial.suggest_categorical("n_steps", [1, 3, 5])
    trial.suggest_float("tau", 3e-3, 3e-2, log=True)
    trial.suggest_float("noise_std", 0.05, 0.5, log=True)
    return convert_params(_learning_as_often(trial, n_envs))


def _learning_as_often(trial: optuna.Trial, n_envs: int) -> dict[str, Any]:
    """A trial's numbers, that of the updates among them: whoever repeats it (``--trial-id``) has no others."""
    trial.suggest_int("gradient_steps", n_envs, n_envs)
    return trial.params


def convert_params(params: dict[str, Any]) -> dict[str, Any]:
    """From a study's numbers to constructor arguments (rl_zoo3's ``--trial-id``): they are the same.

    :param params: of a trial
    """
    return dict(params)
