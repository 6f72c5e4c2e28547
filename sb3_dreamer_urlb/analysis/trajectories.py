"""Trajectories of an oracle: what it saw and did, played by any snapshot or read from a folder of recorded episodes."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, VecTransposeImage, unwrap_vec_normalize

from sb3_dreamer_urlb.envs.info_keys import TERMINAL
from sb3_dreamer_urlb.evaluation.episodes import as_played
from sb3_dreamer_urlb.evaluation.protocol import stacked
from sb3_dreamer_urlb.folders import made_folder
from sb3_dreamer_urlb.number_checks import check_integer
from sb3_dreamer_urlb.types import SequenceBatch

if TYPE_CHECKING:
    from sb3_dreamer_urlb.dreamer_v2 import DreamerV2
    from sb3_dreamer_urlb.dreamer_v2.policies import DreamerPolicy

#: of the paper, for each task
TRAJECTORIES = 30
#: of the first episode; the others follow
SEED = 2000
#: how the observations of Dict spaces are named in a file
OBSERVATION = "observation"


@dataclass
class Trajectory:
    """One episode of T steps.

    :param observations: of the environment, before any VecNormalize (each agent has its own); images channels first,
        (T + 1, …); by name for Dict spaces
    :param actions: as the environment received them, (T, …)
    :param rewards: of the task, float (T,)
    :param name: of the file, for messages
    """

    observations: np.ndarray | dict[str, np.ndarray]
    actions: np.ndarray
    rewards: np.ndarray
    name: str = ""

    def __len__(self) -> int:
        return len(self.actions)


def play_trajectories(model: DreamerV2, env: GymEnv | str, count: int = TRAJECTORIES, seed: int = SEED) -> list[Trajectory]:
    """Let an oracle play, deterministically, as it has learnt to act.

    :param model: the oracle
    :param env: of the task, vectorised or not, or its id
    :param count: episodes
    :param seed: of the first; episode ``i`` begins with the seed ``seed + i``
    :raises ValueError: for a number that is not positive, or a wrapper around VecNormalize that changes observations further:
        what the environment gave is then lost
    """
    check_integer("trajectories", count, 1)
    env, normalizer = _before_normalization(as_played(model, env))
    played: list[Trajectory] = []
    with th.random.fork_rng([model.device] if model.device.type == "cuda" else []):
        th.manual_seed(seed)
        while len(played) < count:
            played += _first_episodes(model, env, normalizer, min(env.num_envs, count - len(played)), seed + len(played))
    return played


def _before_normalization(env: VecEnv) -> tuple[VecEnv, VecNormalize | None]:
    """What gives observations as they are, and what normalises them for the agent."""
    normalizer = unwrap_vec_normalize(env)
    if normalizer is None:
        return env, None
    outer = env
    while isinstance(outer, VecTransposeImage):
        outer = outer.venv
    if outer is not normalizer:
        raise ValueError(f"Trajectories hold what the environment gave: {type(outer).__name__} around VecNormalize hides it.")
    return normalizer.venv, normalizer


def _first_episodes(model: DreamerV2, env: VecEnv, normalizer: VecNormalize | None, count: int, seed: int) -> list[Trajectory]:
    env.seed(seed)
    observation: Any = env.reset()
    state: tuple[np.ndarray, ...] | None = None
    start = np.ones(env.num_envs, bool)
    seen: list[list[Any]] = [[row] for row in _rows(model, observation)[:count]]
    actions: list[list[np.ndarray]] = [[] for _ in range(count)]
    rewards: list[list[float]] = [[] for _ in range(count)]
    going = np.ones(count, bool)
    while going.any():
        shown: Any = observation if normalizer is None else normalizer.normalize_obs(observation)
        action, state = model.predict(shown, state, start, deterministic=True)
        observation, reward, start, infos = env.step(action)
        rows = _rows(model, observation)
        for i in np.flatnonzero(going):
            last = infos[i][TERMINAL] if start[i] else None
            seen[i].append(rows[i] if last is None else _rows(model, last)[0])
            actions[i].append(action[i])
            rewards[i].append(float(reward[i]))
        going &= ~start[:count]
    return [Trajectory(stacked(seen[i]), np.stack(actions[i]), np.array(rewards[i], np.float32)) for i in range(count)]


def _rows(model: DreamerV2, observation: Any) -> list[Any]:
    """Observations of n environments one by one, as the policy takes them."""
    tensors = model.policy.obs_to_tensor(observation)[0]
    if isinstance(tensors, dict):
        arrays = {name: part.cpu().numpy() for name, part in tensors.items()}
        return [{name: part[i] for name, part in arrays.items()} for i in range(len(next(iter(arrays.values()))))]
    return list(tensors.cpu().numpy())


# -- files -----------------------------------------------------------------------------------------------------------------


def save_trajectories(trajectories: Sequence[Trajectory], folder: str | os.PathLike[str]) -> None:
    """Write one ``.npz`` an episode: ``observation``, ``action``, ``reward``.

    :param trajectories: to write
    :param folder: made if it is not there
    """
    folder = made_folder("folder", folder)
    for i, one in enumerate(trajectories):
        seen = one.observations
        named = {f"{OBSERVATION}/{k}": v for k, v in seen.items()} if isinstance(seen, dict) else {OBSERVATION: seen}
        np.savez_compressed(folder / f"episode-{i:04d}.npz", action=one.actions, reward=one.rewards, **named)  # type: ignore[arg-type]


def load_trajectories(folder: str | os.PathLike[str], count: int = TRAJECTORIES) -> list[Trajectory]:
    """Read the first episodes of a folder, in the order of their names. No code runs from a file.

    :param folder: of :func:`save_trajectories`
    :param count: how many
    :raises FileNotFoundError: if there is no such folder
    :raises ValueError: if it holds fewer, or a file that is no recorded episode, naming it
    """
    check_integer("trajectories", count, 1)
    folder = Path(folder)
    if not folder.is_dir():
        raise FileNotFoundError(f"There is no folder {folder} of recorded episodes.")
    files = sorted(folder.glob("*.npz"))
    if len(files) < count:
        raise ValueError(f"{count} trajectories are asked for, {folder} holds {len(files)}.")
    return [_load(file) for file in files[:count]]


def _load(path: Path) -> Trajectory:
    try:
        with np.load(path, allow_pickle=False) as file:
            named = {name: file[name] for name in file.files}
        actions, rewards = named.pop("action"), named.pop("reward")
        seen: Any = named.get(OBSERVATION)
        if seen is None:
            seen = {name.removeprefix(f"{OBSERVATION}/"): part for name, part in named.items()}
        lengths = {len(part) - 1 for part in (seen.values() if isinstance(seen, dict) else [seen])} | {len(rewards)}
    except Exception as error:
        raise ValueError(f"{path} is no recorded episode: {error}") from error
    if lengths != {len(actions)} or len(actions) == 0:
        raise ValueError(f"{path} is no recorded episode: {len(actions)} actions with parts of {sorted(lengths)} steps.")
    return Trajectory(seen, actions, rewards, str(path))


# -- what a model takes ----------------------------------------------------------------------------------------------------


def check_has_model(model: Any) -> None:
    """
    :param model: of any algorithm
    :raises ValueError: if it has no world model
    """
    if not hasattr(model.policy, "agent") or not hasattr(model.policy.agent, "world_model"):
        raise ValueError(f"The analysis needs an agent with a world model, {type(model).__name__} has none.")


def check_fits(model: DreamerV2, trajectories: Sequence[Trajectory]) -> None:
    """Whether a model can follow trajectories.

    :param model: that is to infer their states
    :param trajectories: at least one
    :raises ValueError: naming what differs
    """
    if not trajectories:
        raise ValueError("No trajectories are given.")
    seen, other = _shapes(model.observation_space), [_shapes(one.observations) for one in trajectories]
    acted = [one.actions.shape[1:] for one in trajectories]
    if any(one != seen for one in other):
        raise ValueError(f"The model sees {seen}, the trajectories hold {next(one for one in other if one != seen)}.")
    if any(shape != model.action_space.shape for shape in acted):
        raise ValueError(f"The model's actions are {model.action_space}, those of the trajectories have the shape {acted[0]}.")
    for i, trajectory in enumerate(trajectories):
        _check_values(model.action_space, trajectory, f"{trajectory.name or 'Trajectories'}, episode {i}")


def _check_values(actions: spaces.Space[Any], trajectory: Trajectory, where: str) -> None:
    """
    :raises ValueError: naming the first row with a number that is not finite, or an action that the space does not hold
    """
    seen = trajectory.observations
    parts = {f"{OBSERVATION} {name}": part for name, part in seen.items()} if isinstance(seen, dict) else {OBSERVATION: seen}
    for name, part in {**parts, "action": trajectory.actions, "reward": trajectory.rewards}.items():
        try:
            wrong = ~np.isfinite(np.asarray(part)).reshape(len(part), -1).all(1)
        except TypeError as error:
            raise ValueError(f"{where}: its {name} holds no numbers, but {np.asarray(part).dtype}.") from error
        if wrong.any():
            raise ValueError(f"{where}, row {wrong.argmax()}: its {name} is not finite.")
    if isinstance(actions, spaces.Box):
        given, room = np.asarray(trajectory.actions, np.float64), 1e-4 * (1 + np.abs(actions.high) + np.abs(actions.low))
        wrong = ((given < actions.low - room) | (given > actions.high + room)).reshape(len(given), -1).any(1)
    else:
        wrong = np.array([not actions.contains(np.asarray(one, actions.dtype)) for one in trajectory.actions])
    if wrong.any():
        row = int(wrong.argmax())
        raise ValueError(f"{where}, row {row}: the action {trajectory.actions[row]} is none of {actions}.")


def _shapes(seen: Any) -> Any:
    """Of one observation, by a space or by observations one after the other."""
    if isinstance(seen, dict | spaces.Dict):
        return {name: _shapes(part) for name, part in sorted(seen.items())}
    return seen.shape if isinstance(seen, spaces.Space) else np.shape(seen)[1:]


def as_batch(policy: DreamerPolicy, trajectory: Trajectory, normalizer: VecNormalize | None = None) -> SequenceBatch:
    """One trajectory as the replay would hand it to the model, (1, T + 1, …).

    :param policy: that scales the actions
    :param trajectory: what happened
    :param normalizer: of the agent's observations; its statistics do not move
    """
    device, seen = policy.device, trajectory.observations
    if normalizer is not None:
        seen = normalizer.normalize_obs(seen)
    observation: Any
    if isinstance(seen, dict):
        observation = {name: th.as_tensor(part, device=device)[None] for name, part in seen.items()}
    else:
        observation = th.as_tensor(seen, device=device)[None]
    scaled = policy.actions.from_env(trajectory.actions)
    action = th.as_tensor(np.concatenate([np.zeros_like(scaled[:1]), scaled]), dtype=th.float32, device=device)[None]
    reward = th.as_tensor(np.concatenate([[0.0], trajectory.rewards]), dtype=th.float32, device=device)[None]
    is_first = th.zeros(reward.shape, dtype=th.bool, device=device)
    is_first[:, 0] = True
    return SequenceBatch(observation, action, reward, is_first, th.zeros_like(is_first))
