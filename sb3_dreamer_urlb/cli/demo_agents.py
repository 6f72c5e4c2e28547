"""The agents of the demonstration, each in a process of its own: one explores without rewards, two learn a task."""

from __future__ import annotations

import csv
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch as th
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

from sb3_dreamer_urlb.algorithm.advice import NoUpdateWarning
from sb3_dreamer_urlb.dreamer_v2 import DreamerV2
from sb3_dreamer_urlb.envs import RenderingBackendError
from sb3_dreamer_urlb.evaluation.agent_rows import row_of
from sb3_dreamer_urlb.evaluation.append import append_rows
from sb3_dreamer_urlb.evaluation.episodes import OFF, ON, run_evaluation
from sb3_dreamer_urlb.evaluation.recording import record
from sb3_dreamer_urlb.folders import made_folder
from sb3_dreamer_urlb.snapshots.vec_normalize import beside, load_vec_normalize, save_vec_normalize

#: frames of a film, and its side in pixels
FILM_STEPS, FILM_SIDE = 150, 192
#: episodes that logged returns average over
WINDOW = 3


@dataclass(frozen=True)
class Agent:
    """What one agent does.

    :param folder: for everything that it writes
    :param env_id: of its task
    :param frames: of the environment
    :param seed: of everything random
    :param preset: of the model
    :param snapshot: pre-trained agent that it starts from; None starts from nothing. The statistics of its observations lie
        beside it
    :param episodes: of the evaluation at its end
    """

    folder: Path
    env_id: str
    frames: int
    seed: int
    preset: str
    snapshot: Path | None = None
    episodes: int = 0

    @property
    def statistics(self) -> Path | None:
        """Of the observations that the snapshot was trained on."""
        return None if self.snapshot is None else beside(self.snapshot)


def make_env(env_id: str, n_envs: int = 1, statistics: Path | None = None, training: bool = True, monitor: str | None = None,
             filmed: bool = False) -> VecNormalize:  # fmt: skip
    """States of a task, normalised.

    :param env_id: of the package
    :param n_envs: how many
    :param statistics: of somebody's observations, to go on from
    :param training: let them move
    :param monitor: folder of the log of episodes
    :param filmed: can be drawn
    """
    film: dict[str, Any] = {"render_mode": "rgb_array", "render_size": FILM_SIDE} if filmed else {}
    plain: VecEnv = DummyVecEnv([lambda: Monitor(gymnasium.make(env_id, observation="state", **film), monitor)] * n_envs)
    if statistics is None:
        return VecNormalize(plain, training=training, norm_reward=False)
    env = load_vec_normalize(statistics, plain, training)
    env.norm_reward = False
    return env


def explore(agent: Agent) -> Path:
    """Pre-train with LBS, without a reward.

    :param agent: what to do
    :return: the snapshot; the statistics of its observations lie beside it
    """
    made_folder("--out", agent.folder)
    model = _new_model(agent, agent.seed, intrinsic_reward="lbs")
    _learn(agent, model)
    for optimizer in model.learner.optimizers().values():
        # Fine-tuning starts with fresh ones, and they are two thirds of a file.
        optimizer.adam.state.clear()
    return _save(model, agent.folder / "pretrained.zip")


def learn_task(agent: Agent) -> Path:
    """Learn a task, pre-trained or not, then play: evaluations with and without Dyna-MPC in ``rows.csv``, and a film.

    :param agent: what to do
    :return: the snapshot
    """
    made_folder("--out", agent.folder)
    if agent.snapshot is None:
        model = _new_model(agent, 1000 + agent.seed)
    else:
        env = make_env(agent.env_id, statistics=agent.statistics, monitor=str(agent.folder))
        env.seed(1000 + agent.seed)
        arguments: dict[str, Any] = {"seed": agent.seed, "stats_window_size": WINDOW}
        model = DreamerV2.load(agent.snapshot, env=env, device="cpu", **arguments)
        # Walker: the actor is kept, as in the paper (§3).
        model.fine_tune()
    _learn(agent, model)
    finished = _save(model, agent.folder / "finetuned.zip")
    _play(agent, finished)
    return finished


def _new_model(agent: Agent, env_seed: int, intrinsic_reward: str | None = None) -> DreamerV2:
    env = make_env(agent.env_id, monitor=str(agent.folder))
    env.seed(env_seed)
    return DreamerV2(
        "MlpPolicy",
        env,
        preset=agent.preset,
        intrinsic_reward=intrinsic_reward,
        seed=agent.seed,
        device="cpu",
        stats_window_size=WINDOW,
    )


def _learn(agent: Agent, model: DreamerV2) -> None:
    # Processes share the cores, and the networks are small: more threads would wait for each other.
    th.set_num_threads(1)
    model.set_logger(configure(str(agent.folder), ["csv"]))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NoUpdateWarning)  # said before, once for both
        model.learn(-(-agent.frames // model.action_repeat), log_interval=1)


def _save(model: DreamerV2, path: Path) -> Path:
    env = model.get_vec_normalize_env()
    assert env is not None
    save_vec_normalize(env, beside(path))
    model.save(path)
    return path


def _play(agent: Agent, finished: Path) -> None:
    statistics = beside(finished)
    env = make_env(agent.env_id, agent.episodes, statistics, training=False)
    model = DreamerV2.load(finished, env=env, device="cpu", planner="dyna_mpc")
    played = [run_evaluation(model, env, agent.episodes, planner=planner) for planner in (OFF, ON)]
    append_rows(agent.folder / "rows.csv", [row_of(model, env, each) for each in played])
    try:
        shown = make_env(agent.env_id, statistics=statistics, training=False, filmed=True)
        shown.seed(agent.seed)
        actor = DreamerV2.load(finished, env=shown, device="cpu")
        np.save(agent.folder / "film.npy", np.stack(record(actor, shown, FILM_STEPS).frames))
    except RenderingBackendError as error:
        print(f"No film: {error}", flush=True)


def episodes(folder: Path) -> list[float]:
    """Returns of the training episodes that an agent has finished, in their order.

    :param folder: of the agent
    """
    path = folder / "monitor.csv"
    if not path.exists():
        return []
    with open(path, newline="") as file:
        # The first line says what was run; the last may be half written.
        lines = [line for line in file if line.endswith("\n")][1:]
    return [float(row["r"]) for row in csv.DictReader(lines)]
