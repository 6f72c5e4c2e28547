"""What commands share that play a saved agent: their options, the agent, and environments for it."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_dreamer_urlb.command_parser import a_path, a_seed, at_least

if TYPE_CHECKING:
    from stable_baselines3.common.vec_env import VecEnv


def add_evaluation_arguments(parser: argparse.ArgumentParser) -> None:
    """Which environment, and what episodes.

    :param parser: of a command
    """
    parser.add_argument("--env", required=True, help="id of the environment, such as urlb/walker-run-v0")
    parser.add_argument("--env-kwargs", nargs="+", metavar="NAME=VALUE", help="arguments of the environment")
    parser.add_argument("--episodes", type=at_least(1), default=10, help="(default: %(default)s)")
    parser.add_argument("--envs", type=at_least(1), help="environments at a time (default: as many as episodes, at most 10)")
    parser.add_argument("--seed", type=a_seed, default=1000, help="of the first episode (default: %(default)s)")


def add_statistics_argument(parser: argparse.ArgumentParser, whose: str = "") -> None:
    """How observations are normalised.

    :param parser: of a command
    :param whose: other agent's, ``"oracle"``
    """
    parser.add_argument(
        f"--{whose}-vec-normalize" if whose else "--vec-normalize",
        type=a_path,
        help=f"statistics of the {whose + ' ' if whose else ''}observations, JSON (default: a run folder's own, or "
        "NAME.vec_normalize.json beside NAME.zip)",
    )


def environments_at_a_time(options: dict[str, Any]) -> int:
    """How many environments to play the episodes in.

    :param options: of the command line
    """
    return int(options.get("envs", min(options["episodes"], 10)))


def load_agent(options: dict[str, Any], envs: int, **arguments: Any) -> tuple[Any, VecEnv]:
    """A saved agent and an environment for it.

    :param options: of the command line: ``snapshot``, ``env``, ``device``, and, if given, ``env_kwargs``, ``vec_normalize``
    :param envs: how many environments
    :param arguments: of the model, in place of those in the file
    """
    from sb3_dreamer_urlb.devices import known_device
    from sb3_dreamer_urlb.evaluation.loading import algorithm_of

    known_device(options["device"], "--device")
    path, env = _file(options["snapshot"]), environment_of(options, envs)
    try:
        with _hinting_at_states(env):
            return algorithm_of(path).load(path, env=env, device=options["device"], **arguments), env
    except BaseException:
        env.close()
        raise


@contextmanager
def _hinting_at_states(env: VecEnv) -> Iterator[None]:
    """What does not fit an environment of pictures may be an agent that sees states: say how it is given them."""
    try:
        yield
    except ValueError as error:
        shape = getattr(env.observation_space, "shape", None)
        spec = getattr(env.unwrapped.envs[0], "spec", None) if hasattr(env.unwrapped, "envs") else None
        makes_states = spec is not None and spec.id.startswith(("urlb/", "rwrl/"))
        if makes_states and shape is not None and len(shape) == 3 and ("shape" in str(error) or "space" in str(error)):
            raise ValueError(
                f"{str(error).rstrip('.')}. An agent that sees states needs --env-kwargs observation=state."
            ) from error
        raise


@contextmanager
def _telling_the_arguments(kwargs: dict[str, Any]) -> Iterator[None]:
    """A value of the wrong kind is what makes an environment's own code, or Gymnasium's, raise a TypeError."""
    try:
        yield
    except TypeError as error:
        if not kwargs:
            raise
        raise ValueError(f"The environment cannot be made with --env-kwargs {kwargs}: {error}") from error


def environment_of(options: dict[str, Any], envs: int) -> VecEnv:
    """An environment as a saved agent knows it, without the agent.

    :param options: of the command line: ``snapshot``, ``env``, and, if given, ``env_kwargs``, ``vec_normalize``
    :param envs: how many environments
    """
    from stable_baselines3.common.env_util import make_vec_env

    from sb3_dreamer_urlb.envs.registration import naming_near_ids
    from sb3_dreamer_urlb.evaluation.loading import normalized_as_saved
    from sb3_dreamer_urlb.snapshots.vec_normalize import beside, load_vec_normalize

    kwargs = {name: typed(value) for name, value in pairs("--env-kwargs", options.get("env_kwargs", ())).items()}
    snapshot = _file(options["snapshot"])
    with naming_near_ids(options["env"]), _telling_the_arguments(kwargs):
        env = make_vec_env(options["env"], envs, env_kwargs=kwargs)
    try:
        statistics = options.get("vec_normalize") or (beside(snapshot) if beside(snapshot).is_file() else None)
        with _hinting_at_states(env):
            return normalized_as_saved(env, snapshot) if statistics is None else load_vec_normalize(statistics, env)
    except BaseException:
        env.close()
        raise


def _file(snapshot: Path) -> Path:
    """Of a run folder, its last checkpoint; also where rl_zoo3 keeps it, in a folder of the run's.

    :raises FileNotFoundError: if a folder has none
    """
    from sb3_dreamer_urlb.runs.run_folder import CHECKPOINT, SNAPSHOT

    if not snapshot.is_dir():
        return snapshot
    places = [snapshot / SNAPSHOT, snapshot / CHECKPOINT / SNAPSHOT]
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        raise FileNotFoundError(f"{snapshot} has no checkpoint: neither {' nor '.join(map(str, places))} is there.")
    return found


def pairs(option: str, texts: Any) -> dict[str, str]:
    """Options of the form NAME=VALUE, by name.

    :param option: for the message
    :param texts: as they were given
    :raises ValueError: for another form, and for a name that is there twice
    """
    found: dict[str, str] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not (name and equals):
            raise ValueError(f"{option}: expected NAME=VALUE, got {text!r}.")
        if found.setdefault(name, value) != value:
            raise ValueError(f"{option}: {name} is given twice, as {found[name]!r} and as {value!r}.")
    return found


def typed(text: str) -> Any:
    """A value as it was meant: a number, true, false, none, JSON, or else the text itself."""
    try:
        return json.loads(text.lower() if text in ("True", "False") else text)
    except ValueError:
        return None if text.lower() == "none" else text
