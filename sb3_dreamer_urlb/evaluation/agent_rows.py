"""What a row says about the agent that was evaluated and the environment that it played in."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec
from stable_baselines3.common.vec_env import VecEnv

from sb3_dreamer_urlb.envs.facts import env_attribute
from sb3_dreamer_urlb.envs.naming import task_columns
from sb3_dreamer_urlb.evaluation.episodes import Evaluation
from sb3_dreamer_urlb.evaluation.rows import ACTING, CHANGED, LEARNT, REQUIRED, Row
from sb3_dreamer_urlb.evaluation.settings import as_text, settings_of
from sb3_dreamer_urlb.phases import PHASES
from sb3_dreamer_urlb.snapshots import values

#: classes of algorithms → what a run of theirs without pre-training is called
FROM_SCRATCH = {"DreamerV2": "dreamer", "DrQv2": "drqv2"}
#: arguments of environments that other columns have
IN_OTHER_COLUMNS = {"domain", "task", "observation"}
PACKAGES = ("torch", "numpy", "gymnasium", "stable-baselines3", "dm-control", "mujoco")


def row_of(
    model: Any,
    env: VecEnv,
    evaluation: Evaluation,
    keep_actor: bool | None = None,
    keep_critic: bool | None = None,
    **columns: Any,
) -> Row:
    """One row about an evaluation.

    :param model: that was evaluated
    :param env: that it was evaluated in
    :param evaluation: what came of it
    :param keep_actor: whether its fine-tuning began with the pre-trained actor; None takes what the model knows, which is
        nothing if it comes from a file of version 3 or older
    :param keep_critic: likewise for the critic
    :param columns: further columns, or other values for required ones
    """
    facts = {**env_columns(env), **agent_columns(model, keep_actor, keep_critic)}
    facts |= _what_was_played(model, facts, evaluation)
    facts |= {
        "planner": evaluation.planner,
        "return_mean": evaluation.mean,
        "return_std": evaluation.std,
        "episodes": len(evaluation.returns),
        "seconds": round(evaluation.seconds, 3),
        "evaluation_seed": evaluation.seed,
        "returns": " ".join(f"{value:.6g}" for value in evaluation.returns),
        "versions": versions(),
        "device": str(getattr(model, "device", "")),
        **columns,
    }
    further = {name: str(facts.pop(name)) for name in list(facts) if name not in REQUIRED}
    return Row(**facts, further=further)


def _what_was_played(model: Any, facts: dict[str, Any], evaluation: Evaluation) -> dict[str, str]:
    """Columns that keep a row out of the benchmark's tables: an agent of another task, or one that draws its actions."""
    here, learnt = f"{facts['domain']}-{facts['task']}", getattr(model, "learnt_task", None)
    others = {LEARNT: learnt} if facts["finetune_frames"] > 0 and learnt not in (None, here) else {}
    return {**others, **({} if evaluation.deterministic else {ACTING: "stochastic"})}


def was_fine_tuned(model: Any) -> bool:
    """Whether a model is past a pre-training.

    :param model: any of Stable-Baselines3
    """
    exploring = PHASES[model.phase].explores if hasattr(model, "phase") else False
    return not exploring and int(getattr(model, "pretrained_frames", 0)) > 0


def agent_columns(model: Any, keep_actor: bool | None = None, keep_critic: bool | None = None) -> dict[str, Any]:
    """What a model tells about itself: method, seed, frames, what it kept, preset, algorithm; ``known_reward`` if it was, and
    ``settings`` where hyperparameters are otherwise than the preset's.

    :param model: any of Stable-Baselines3
    :param keep_actor: see :func:`row_of`
    :param keep_critic: likewise
    """
    algorithm = type(model).__name__
    reward = getattr(model, "intrinsic_reward", None)
    exploring = PHASES[model.phase].explores if hasattr(model, "phase") else False
    frames = int(getattr(model, "phase_frames", model.num_timesteps))
    pretrained = frames if exploring else int(getattr(model, "pretrained_frames", 0))
    if reward is None:
        method = FROM_SCRATCH.get(algorithm, algorithm.lower())
    else:
        method = reward if isinstance(reward, str) else getattr(reward, "__name__", type(reward).__name__)
    tuned = was_fine_tuned(model)
    kept = getattr(model, "kept", None) or {}
    return {
        "method": method,
        "seed": -1 if model.seed is None else model.seed,
        "pretrain_frames": pretrained,
        "finetune_frames": 0 if exploring else frames,
        "keep_actor": (kept.get("actor") if keep_actor is None else keep_actor) if tuned else None,
        "keep_critic": (kept.get("critic") if keep_critic is None else keep_critic) if tuned else None,
        "preset": getattr(model, "preset", ""),
        "algorithm": algorithm,
        **({"settings": text} if (text := as_text(settings_of(model))) else {}),
        **({"known_reward": "true"} if tuned and kept.get("reward") else {}),
    }


def env_columns(env: VecEnv) -> dict[str, Any]:
    """Domain, task, and how the task is changed or seen, from the id of the environment and the arguments that made it.

    :param env: vectorised
    """
    spec = env_attribute(env, "spec", None)
    columns: dict[str, Any] = dict(task_columns(env))
    given = {} if spec is None else spec.kwargs
    if isinstance(given.get("observation"), str) and given["observation"] != "pixels":
        columns["observation"] = given["observation"]
    changed = {} if spec is None else {n: v for n, v in changed_arguments(spec).items() if n not in IN_OTHER_COLUMNS}
    if changed:
        columns[CHANGED] = _as_text(changed)
    return columns


def changed_arguments(spec: EnvSpec) -> dict[str, Any]:
    """What ``gymnasium.make`` was told beside the id and otherwise than it is registered; not how to draw it.

    :param spec: of the environment
    :return: as JSON
    """
    registered = gymnasium.registry.get(spec.id)
    usual = {} if registered is None else registered.kwargs
    given = {name: values.encode_or_describe(value) for name, value in spec.kwargs.items() if name != "render_mode"}
    found = {n: value for n, value in given.items() if n not in usual or value != values.encode_or_describe(usual[n])}
    if registered is not None and spec.max_episode_steps != registered.max_episode_steps:
        found["max_episode_steps"] = spec.max_episode_steps
    return found


def _as_text(arguments: dict[str, Any]) -> str:
    plain = (str, int, float, bool, type(None))
    return ", ".join(f"{name}={value if isinstance(value, plain) else '...'}" for name, value in sorted(arguments.items()))


def versions() -> str:
    """Of Python and the packages that results depend on, and of this one."""
    from sb3_dreamer_urlb.version import __version__

    found = [f"sb3_dreamer_urlb {__version__}", f"python {platform.python_version()}"]
    for package in PACKAGES:
        try:
            found.append(f"{package} {version(package)}")
        except PackageNotFoundError:
            continue
    return ", ".join(found)


def results_of(evaluations: list[Evaluation], timesteps: list[int]) -> dict[str, np.ndarray]:
    """As Stable-Baselines3 writes ``evaluations.npz``.

    :param evaluations: with equally many episodes each
    :param timesteps: agent steps of the model at each
    """
    return {
        "timesteps": np.array(timesteps),
        "results": np.array([evaluation.returns for evaluation in evaluations]),
        "ep_lengths": np.array([evaluation.lengths for evaluation in evaluations]),
    }
