"""Puts our algorithms into rl_zoo3, and mends the places where rl_zoo3 knows nothing of phases and of runs that go on.

rl_zoo3 has no entry points: its modules share two dictionaries and a class, which are changed here in place.
"""

from __future__ import annotations

import functools
import importlib
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from pprint import pprint
from typing import Any
from unittest import mock

import yaml
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv

from sb3_dreamer_urlb.algorithm import PhasedAlgorithm
from sb3_dreamer_urlb.callbacks.checkpoint import RunCheckpointCallback
from sb3_dreamer_urlb.callbacks.phase_switch import FineTuneCallback
from sb3_dreamer_urlb.callbacks.videos import VideoCallback
from sb3_dreamer_urlb.devices import known_device
from sb3_dreamer_urlb.envs.supervisor import SupervisedVecEnv
from sb3_dreamer_urlb.phases import PRETRAINING
from sb3_dreamer_urlb.runs.run_folder import CHECKPOINT, steps_done
from sb3_dreamer_urlb.signatures import named_parameters
from sb3_dreamer_urlb.snapshots.vec_normalize import beside, load_vec_normalize
from sb3_dreamer_urlb.zoo import configs, env_arguments, hyperparameters, mistakes, pretraining, resuming, schedules
from sb3_dreamer_urlb.zoo.algorithms import ALGORITHMS
from sb3_dreamer_urlb.zoo.callbacks import RunSnapshotCallback
from sb3_dreamer_urlb.zoo.monitor_files import put_monitor_files_aside


def register() -> None:
    """Make ``--algo dreamerv2`` and ``--algo drq_v2`` known to rl_zoo3. May be called again."""
    known = importlib.import_module("rl_zoo3.utils").ALGOS
    optimization = importlib.import_module("rl_zoo3.hyperparams_opt")
    for name, algorithm in ALGORITHMS.items():
        known[name] = algorithm.kind
        optimization.HYPERPARAMS_SAMPLER[name] = algorithm.sampler
        optimization.HYPERPARAMS_CONVERTER[name] = algorithm.converter
    # The class is absent while its own module is what imports custom_envs.py (record_video), where nobody trains.
    manager = getattr(importlib.import_module("rl_zoo3.exp_manager"), "ExperimentManager", None)
    if manager is not None:
        for name, around in _AROUND.items():
            original = getattr(manager, name)
            if not hasattr(original, "_knows_phases"):
                setattr(manager, name, _wrap(original, around))


def _wrap(original: Callable[..., Any], around: Callable[..., Any]) -> Callable[..., Any]:
    """``around(original, manager, ...)`` in place of ``original(manager, ...)``, for our algorithms only."""

    @functools.wraps(original)
    def wrapped(manager: Any, *args: Any, **kwargs: Any) -> Any:
        if manager.algo not in ALGORITHMS:
            return original(manager, *args, **kwargs)
        return around(original, manager, *args, **kwargs)

    wrapped._knows_phases = True  # type: ignore[attr-defined]
    return wrapped


def _read_hyperparameters(original: Callable[..., Any], manager: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """Without ``-conf``, rl_zoo3 would look for a file inside its own package; a run that goes on has its own.

    Three keys are ours: ``resume: auto``, ``checkpoint``, False or the keyword arguments of RunCheckpointCallback, and
    ``pretrain_env``.

    :raises ValueError: if there is no file to read, for values of the three keys that mean nothing, for a run that is still
        going
    """
    known_device(manager.device, "--device")
    options = manager.args
    run = resuming.run_at(getattr(options, "run_folder", "") or manager.trained_agent)
    given, manager.env_kwargs = manager.env_kwargs, {}  # rl_zoo3 would forget the configuration's
    if run is not None and getattr(options, "conf_file", manager.config) is None:
        hyperparams = {**resuming.saved(run, "config"), **(manager.custom_hyperparams or {})}
        config = dict(sorted(hyperparams.items()))
        print(f"Hyperparameters of the run in {run}:")
        pprint(config)
    else:
        if getattr(options, "conf_file", manager.config) is None:
            manager.config = str(_default_config(manager.algo, manager.env_name.gym_id))
        else:
            manager.config = configs.resolve(manager.config, manager.algo)
            configs.check(manager.config, manager.env_name.gym_id)
        hyperparams, config = original(manager)
        if run is not None and resuming.has_checkpoint(run):
            resuming.check_same(run, hyperparams, manager.custom_hyperparams)
    env_arguments.merge(manager, given, hyperparams, config)
    hyperparameters.check(hyperparams, manager.algo, named_parameters(ALGORITHMS[manager.algo].kind))
    if "policy" not in hyperparams:
        raise ValueError(f"The hyperparameters of {manager.env_name.gym_id} in {manager.config} name no policy.")
    if manager.n_timesteps <= 0 and "n_timesteps" not in hyperparams:
        raise ValueError(f"How long? Neither -n nor n_timesteps of {manager.env_name.gym_id} in {manager.config} says so.")
    hyperparams.setdefault("n_timesteps", manager.n_timesteps)  # -n is enough, rl_zoo3 wants both
    resume = hyperparams.pop("resume", None) or getattr(options, "resume", None)
    checkpoint = hyperparams.pop("checkpoint", True)
    manager.pretrain_env = hyperparams.pop("pretrain_env", pretraining.PRIMAL)
    if manager.pretrain_env not in pretraining.CHOICES:
        raise ValueError(f"pretrain_env must be one of {pretraining.CHOICES}, got {manager.pretrain_env!r}.")
    if resume not in (None, resuming.AUTO):
        raise ValueError(f"resume must be 'auto' or false, got {resume!r}.")
    if not isinstance(checkpoint, bool | dict):
        raise ValueError(f"checkpoint must be true, false or keyword arguments of RunCheckpointCallback, got {checkpoint!r}.")
    if manager.optimize_hyperparameters:
        return hyperparams, config
    manager.checkpoint_options = {} if checkpoint is True else checkpoint
    if run is None and resume is not None:
        run = _find_run(manager, config, hyperparams)
    if run is not None:
        _go_on(manager, run, _steps(manager, hyperparams))
    return hyperparams, config


def _preprocess_hyperparams(original: Callable[..., Any], manager: Any, hyperparams: dict[str, Any]) -> tuple[Any, ...]:
    """What rl_zoo3 evaluates is checked before a run's folder is made; learning rates that fall are ours.

    :raises ValueError: for text that is no Python, and for arguments of wrappers that they do not have
    """
    lines = schedules.of_rates(hyperparams, named_parameters(ALGORITHMS[manager.algo].kind))
    env_arguments.use_everywhere(manager, hyperparams.get("env_kwargs"))
    try:
        found: tuple[dict[str, Any], ...] = original(manager, hyperparams)
    except (NameError, SyntaxError) as error:
        raise ValueError(f"A value that is read as Python cannot be: {error}.") from error
    hyperparameters.check_evaluated(manager.normalize_kwargs, manager.monitor_kwargs)
    found[0].update(lines)
    return found


def _default_config(algorithm: str, env_id: str) -> Path:
    there = [path for name in ALGORITHMS[algorithm].configs if (path := configs.folder() / name).is_file()]
    if not there:
        raise ValueError(f"Name a configuration with -conf: {configs.folder()} is not there.")
    knowing = [path for path in there if env_id in yaml.safe_load(path.read_text())]
    # Of an environment that none of them knows, rl_zoo3 complains itself.
    return (knowing or there)[0]


def _steps(manager: Any, hyperparams: dict[str, Any]) -> int:
    """Agent steps of the whole run."""
    return manager.n_timesteps if manager.n_timesteps > 0 else int(hyperparams["n_timesteps"])


def _find_run(manager: Any, config: dict[str, Any], hyperparams: dict[str, Any]) -> Path | None:
    steps = _steps(manager, hyperparams)
    # Otherwise rl_zoo3 has drawn one.
    seed = manager.seed if any(option.split("=")[0] == "--seed" for option in sys.argv) else None
    run = resuming.latest_unfinished(manager.log_path, manager.env_name, config, steps, seed, manager.trained_agent)
    if run is None:
        print("No unfinished run of this configuration: a new one begins.")
    else:
        manager.seed = resuming.saved(run, "args")["seed"]
    return run


def _go_on(manager: Any, run: Path, steps: int) -> None:
    """In the run's own folder, where rl_zoo3 would begin a new one.

    :raises ValueError: for a run that is still going
    """
    if resuming.is_going(run):
        raise ValueError(f"Another process is at work in {run}.")
    manager.save_path, manager.params_path = str(run), str(run / manager.env_name)
    if resuming.has_checkpoint(run):
        if (done := steps_done(run / CHECKPOINT)) >= steps:
            print(f"{run} has done {done} of {steps} steps: -n makes it longer.")
        manager.resumed_run, manager.continue_training = run, True
    else:
        print(f"{run} has no checkpoint yet: the run begins.")


def _save_config(original: Callable[..., Any], manager: Any, config: dict[str, Any]) -> None:
    """How a run began stays as it is."""
    if getattr(manager, "resumed_run", None) is None:
        original(manager, config)
    else:
        print(f"Log path: {manager.save_path}")


def _create_envs(original: Callable[..., Any], manager: Any, *args: Any, **kwargs: Any) -> VecEnv:
    """``--vec-env subproc`` survives processes that die or hang; a run that goes on keeps the episodes it had."""
    if getattr(manager, "resumed_run", None) is not None and not (kwargs.get("eval_env") or kwargs.get("no_log")):
        put_monitor_files_aside(manager.resumed_run)
    if manager.vec_env_class is SubprocVecEnv:
        manager.vec_env_class = SupervisedVecEnv
    if kwargs.get("eval_env") or kwargs.get("no_log") or getattr(manager, "pretrain_env", None) is None:
        return original(manager, *args, **kwargs)
    return pretraining.make_envs(lambda: original(manager, *args, **kwargs), manager)


def _maybe_normalize(original: Callable[..., Any], manager: Any, env: VecEnv, eval_env: bool) -> VecEnv:
    """A snapshot's statistics lie beside it, where rl_zoo3 does not look: without them the world model would see other numbers
    for the same state.

    :raises ValueError: where the configuration does not normalise what the snapshot knows normalised
    """
    statistics = beside(Path(manager.trained_agent)) if manager.trained_agent else None
    if statistics is None or not statistics.is_file() or getattr(manager, "resumed_run", None) is not None:
        wrapped: VecEnv = original(manager, env, eval_env)
        return wrapped
    if not manager.normalize:
        raise ValueError(
            f"{manager.trained_agent} saw its observations through VecNormalize, {statistics.name} has the statistics: "
            f"the configuration must say so, normalize: {{norm_reward: false}}."
        )
    print(f"Observations are normalised as {statistics} says.")
    return load_vec_normalize(statistics, env, training=not eval_env)


def _create_log_folder(original: Callable[..., Any], manager: Any) -> None:
    """Note which folders are new, for the case that the start is refused."""
    run = Path(manager.save_path)
    new = mistakes.missing(run)
    original(manager)
    if run in new:
        mistakes.NEW_FOLDERS.append(new)


def _create_callbacks(original: Callable[..., Any], manager: Any) -> None:
    """Tell snapshots and films their folder, whose number rl_zoo3 chooses; keep the run, so that ``-i`` can go on with it."""
    original(manager)
    for callback in manager.callbacks:
        if isinstance(callback, RunSnapshotCallback):
            callback.save_path = str(Path(manager.save_path) / "snapshots")
        if isinstance(callback, VideoCallback) and callback.folder is None:
            callback.folder = Path(manager.save_path) / "videos"
    evaluation = next((callback for callback in manager.callbacks if isinstance(callback, EvalCallback)), None)
    kept = any(isinstance(callback, RunCheckpointCallback) for callback in manager.callbacks)
    if manager.optimize_hyperparameters or manager.checkpoint_options is False or kept:
        return
    options = {"evaluation": evaluation, "verbose": int(manager.verbose > 0), "resume": "auto", **manager.checkpoint_options}
    manager.callbacks.append(RunCheckpointCallback(Path(manager.save_path) / CHECKPOINT, **options))


def _load_pretrained_agent(
    original: Callable[..., Any], manager: Any, hyperparams: dict[str, Any], env: VecEnv
) -> BaseAlgorithm:
    """``-i`` takes a snapshot's networks from the snapshot, and only takes a replay buffer that belongs to its phase.

    A run that goes on takes everything from its checkpoint, but for what the command line changes.

    :raises ValueError: for a snapshot that was made with other networks than the configuration says
    """
    kind = ALGORITHMS[manager.algo].kind
    expected: dict[str, Any] = {name: hyperparams.pop(name) for name in ("preset", "intrinsic_reward") if name in hyperparams}
    if getattr(manager, "resumed_run", None) is not None:
        changed = {name: hyperparams[name] for name in manager.custom_hyperparams or {} if name in hyperparams}
        own = {"tensorboard_log": manager.tensorboard_log, "verbose": manager.verbose}
        folder = manager.resumed_run / CHECKPOINT
        resumed = kind.resume(folder, env, device=manager.device, **{**own, **changed})
        assert resumed is not None
        _check_expected(manager.resumed_run, expected, resumed)
        return resumed
    fine_tunes = any(isinstance(callback, FineTuneCallback) for callback in manager.callbacks)
    load = functools.partialmethod(_load_fitting_buffer, kind.load_replay_buffer, fine_tunes)
    with mock.patch.object(kind, "load_replay_buffer", load):
        model = original(manager, hyperparams, env)
    _check_expected(manager.trained_agent, expected, model)
    return model


def _check_expected(source: str | Path, expected: dict[str, Any], model: BaseAlgorithm) -> None:
    for name, value in expected.items():
        if value != getattr(model, name):
            raise ValueError(
                f"{source} was made with {name}={getattr(model, name)!r}, the configuration says {value!r}: "
                "a snapshot keeps its networks."
            )


def _load_fitting_buffer(
    model: PhasedAlgorithm, load: Callable[..., None], fine_tunes: bool, path: str, truncate_last_traj: bool = True
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
    "_preprocess_hyperparams": _preprocess_hyperparams,
    "create_envs": _create_envs,
    "_maybe_normalize": _maybe_normalize,
    "create_callbacks": _create_callbacks,
    "_load_pretrained_agent": _load_pretrained_agent,
    "_save_config": _save_config,
    "create_log_folder": _create_log_folder,
}
