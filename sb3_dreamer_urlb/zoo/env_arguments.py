"""Arguments of the environment: of a configuration and of the command line, for training and for all else."""

from __future__ import annotations

from typing import Any


def merge(manager: Any, given: dict[str, Any], hyperparams: dict[str, Any], config: dict[str, Any]) -> None:
    """What the command line says of the environment changes the entries that it names, and leaves the configuration's others.

    :param manager: gets them, those of the evaluation's environment included
    :param given: ``--env-kwargs``
    :param hyperparams: of the configuration; changed in place
    :param config: what is kept of it; changed in place
    """
    of_file = hyperparams.get("env_kwargs") or {}
    if not isinstance(of_file, dict):
        of_file = {}
    if manager._eval_env_kwargs_args is not None:
        manager.eval_env_kwargs = {**of_file, **manager._eval_env_kwargs_args}
    manager.env_kwargs = {**of_file, **given}
    if given:
        hyperparams["env_kwargs"] = config["env_kwargs"] = manager.env_kwargs


def use_everywhere(manager: Any, env_kwargs: dict[str, Any] | None) -> None:
    """rl_zoo3 gives a configuration's arguments of the environment to training alone. Evaluation, films and ``push_to_hub``
    know those of the command line, which lie in the run's ``args.yml``.

    :param manager: whose environments are made next
    :param env_kwargs: the command line's where there were some, else the configuration's
    """
    if env_kwargs and isinstance(env_kwargs, dict):
        manager.args.env_kwargs = dict(env_kwargs)
        if manager._eval_env_kwargs_args is None:
            manager.eval_env_kwargs = dict(env_kwargs)
