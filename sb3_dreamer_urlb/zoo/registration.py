"""Puts DreamerV2 into rl_zoo3, and mends the three places where rl_zoo3 knows nothing of phases (spec/sb3-plugin).

rl_zoo3 has no entry points: its modules share two dictionaries and a class, which are changed here in place.
"""

from __future__ import annotations

import functools
import importlib
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import yaml
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

from sb3_dreamer_urlb.dreamer_v2 import DreamerV2
from sb3_dreamer_urlb.envs.supervisor import SupervisedVecEnv
from sb3_dreamer_urlb.phases import PRETRAINING, FineTuneCallback
from sb3_dreamer_urlb.zoo.callbacks import FiniteWeightsCallback, RunSnapshotCallback
from sb3_dreamer_urlb.zoo.sampler import convert_dreamer_v2_params, sample_dreamer_v2_params

#: rl_zoo3's name of the algorithm; the hub looks for the class's name in lower case
ALGORITHM = "dreamerv2"
#: what ``train`` reads without ``-conf``, in a checkout of the repository: the first of these that knows the environment
DEFAULT_CONFIGS = [Path(__file__).parents[2] / "zoo_configs" / name for name in ("lbs.yml", "vectors.yml")]
#: by name, because rl_zoo3 makes one for each trial
FINITE = f"{FiniteWeightsCallback.__module__}.{FiniteWeightsCallback.__qualname__}"


def register() -> None:
    """Make ``--algo dreamerv2`` known to rl_zoo3. May be called again."""
    algorithms = importlib.import_module("rl_zoo3.utils").ALGOS
    optimization = importlib.import_module("rl_zoo3.hyperparams_opt")
    algorithms[ALGORITHM] = DreamerV2
    optimization.HYPERPARAMS_SAMPLER[ALGORITHM] = sample_dreamer_v2_params
    optimization.HYPERPARAMS_CONVERTER[ALGORITHM] = convert_dreamer_v2_params
    # The class is absent while its own module is what imports custom_envs.py (record_video), where nobody trains.
    manager = getattr(importlib.import_module("rl_zoo3.exp_manager"), "ExperimentManager", None)
    if manager is not None:
        for name, around in _AROUND.items():
            original = getattr(manager, name)
            if not hasattr(original, "_of_dreamer_v2"):
                setattr(manager, name, _wrap(original, around))


def _wrap(original: Callable[..., Any], around: Callable[..., Any]) -> Callable[..., Any]:
    """``around(original, manager, ...)`` in place of ``original(manager, ...)``, for our algorithm only."""

    @functools.wraps(original)
    def wrapped(manager: Any, *args: Any, **kwargs: Any) -> Any:
        if manager.algo != ALGORITHM:
            return original(manager, *args, **kwargs)
        return around(original, manager, *args, **kwargs)

    wrapped._of_dreamer_v2 = True  # type: ignore[attr-defined]
    return wrapped


def _read_hyperparameters(original: Callable[..., Any], manager: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """Without ``-conf``, rl_zoo3 would look for a file inside its own package.

    :raises ValueError: if there is no file to read
    """
    if getattr(manager.args, "conf_file", manager.config) is None:
        there = [path for path in DEFAULT_CONFIGS if path.is_file()]
        if not there:
            raise ValueError("Name a configuration with -conf; this package's repository has some in zoo_configs/.")
        knowing = [path for path in there if manager.env_name.gym_id in yaml.safe_load(path.read_text())]
        # Of an environment that none of them knows, rl_zoo3 complains itself.
        manager.config = str((knowing or there)[0])
    return original(manager)


def _create_envs(original: Callable[..., Any], manager: Any, *args: Any, **kwargs: Any) -> VecEnv:
    """``--vec-env subproc`` survives processes that die or hang."""
    if manager.vec_env_class is SubprocVecEnv:
        manager.vec_env_class = SupervisedVecEnv
    return original(manager, *args, **kwargs)


def _create_callbacks(original: Callable[..., Any], manager: Any) -> None:
    """Tell the snapshots their folder, whose number rl_zoo3 chooses; let each trial of ``-optimize`` stop at NaN."""
    original(manager)
    if manager.optimize_hyperparameters:
        given = manager.specified_callbacks or []
        manager.specified_callbacks = [*(given if isinstance(given, list) else [given]), FINITE]
    for callback in manager.callbacks:
        if isinstance(callback, RunSnapshotCallback):
            callback.save_path = str(Path(manager.save_path) / "snapshots")


def _load_pretrained_agent(
    original: Callable[..., Any], manager: Any, hyperparams: dict[str, Any], env: VecEnv
) -> BaseAlgorithm:
    """``-i`` takes a snapshot's networks from the snapshot, and only takes a replay buffer that belongs to its phase.

    :raises ValueError: for a snapshot that was made with other networks than the configuration says
    """
    expected = {name: hyperparams.pop(name) for name in ("preset", "intrinsic_reward") if name in hyperparams}
    fine_tunes = any(isinstance(callback, FineTuneCallback) for callback in manager.callbacks)
    load = functools.partialmethod(_load_fitting_buffer, DreamerV2.load_replay_buffer, fine_tunes)
    with mock.patch.object(DreamerV2, "load_replay_buffer", load):
        model = original(manager, hyperparams, env)
    for name, value in expected.items():
        if value != getattr(model, name):
            raise ValueError(
                f"{manager.trained_agent} was made with {name}={getattr(model, name)!r}, the configuration says {value!r}: "
                "a snapshot keeps its networks."
            )
    return model


def _load_fitting_buffer(
    model: DreamerV2, load: Callable[..., None], fine_tunes: bool, path: str, truncate_last_traj: bool = True
) -> None:
    """In place of ``model.load_replay_buffer``: rl_zoo3 loads any file that lies beside a snapshot, unasked."""
    if fine_tunes and model.phase == PRETRAINING:
        warnings.warn(f"{path} is left out: a fine-tuning begins with an empty replay buffer.")
        return
    try:
        load(model, path, truncate_last_traj)
    except ValueError as error:
        warnings.warn(f"{path} is left out, the replay buffer begins empty: {error}")


_AROUND: dict[str, Callable[..., Any]] = {
    "read_hyperparameters": _read_hyperparameters,
    "create_envs": _create_envs,
    "create_callbacks": _create_callbacks,
    "_load_pretrained_agent": _load_pretrained_agent,
}
