"""Doing what is missing of a study: pre-train, fine-tune, evaluate, one row a run; what was cut off goes on."""

from __future__ import annotations

import fcntl
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, sync_envs_normalization

from sb3_dreamer_urlb.analysis.manifests import SCRATCH, FineTuning, PreTraining
from sb3_dreamer_urlb.analysis.study_settings import PIXELS, check_same, remember
from sb3_dreamer_urlb.callbacks.checkpoint import RunCheckpointCallback
from sb3_dreamer_urlb.callbacks.snapshot import SnapshotCallback
from sb3_dreamer_urlb.dreamer_v2 import DreamerV2
from sb3_dreamer_urlb.evaluation.agent_rows import row_of
from sb3_dreamer_urlb.evaluation.append import append_row
from sb3_dreamer_urlb.evaluation.episodes import EPISODES, run_evaluation
from sb3_dreamer_urlb.evaluation.rows import read_rows
from sb3_dreamer_urlb.snapshots.vec_normalize import beside, load_vec_normalize, save_vec_normalize


@dataclass
class StudyFolder:
    """Everything of a study: ``rows.csv``, ``snapshots/``, ``tuned/`` and, of runs under way, ``runs/``.

    :param path: made if it is not there
    :param arguments: of :class:`~sb3_dreamer_urlb.DreamerV2`, such as ``preset`` and ``device``
    :param episodes: of an evaluation
    :param make_env: id of an environment, how many → vectorised
    """

    path: Path
    arguments: dict[str, Any] = field(default_factory=dict)
    episodes: int = EPISODES
    make_env: Callable[[str, int], VecEnv] = make_vec_env

    @property
    def settings(self) -> dict[str, Any]:
        """What shapes every row of the folder, beside the runs' own names."""
        known: dict[Any, str] = {make_vec_env: PIXELS, normalized_states: "state"}
        name = f"{self.make_env.__module__}.{getattr(self.make_env, '__qualname__', type(self.make_env).__qualname__)}"
        shaping = {name: value for name, value in self.arguments.items() if name != "device"}
        return {**shaping, "episodes": self.episodes, "observation": known.get(self.make_env, name)}

    @property
    def rows(self) -> Path:
        """One row for each finished run; its name is the column ``run_folder``."""
        return self.path / "rows.csv"

    def snapshot(self, start: PreTraining, length: int) -> Path:
        """Where a pre-trained agent lies."""
        return self.path / "snapshots" / start.name / f"snapshot_{length}.zip"

    def finished(self) -> set[str]:
        """Names of the fine-tunings that have a row."""
        rows = read_rows(self.rows, strict=False).rows if self.rows.exists() else []
        return {row["run_folder"] for row in rows}

    def missing(self, runs: Sequence[FineTuning]) -> list[FineTuning]:
        """Those that have no row yet, in their order.

        :param runs: of the study
        :raises ValueError: if the folder holds runs of other settings
        """
        check_same(self.path, self.settings)
        done = self.finished()
        return [run for run in runs if run.name not in done]

    # -- one run -------------------------------------------------------------------------------------------------------

    def pretrain(self, start: PreTraining) -> None:
        """Pre-train until the last snapshot is there; goes on where it was cut off.

        :param start: the run
        """
        if start.method == SCRATCH:
            return
        last, folder = self.snapshot(start, start.lengths[-1]), self.path / "runs" / start.name
        if last.exists():
            shutil.rmtree(folder, ignore_errors=True)
            return
        env = self.make_env(start.env, 1)
        defaults = {"buffer_size": max(1_000_000, start.lengths[-1] // 2)} if "buffer_size" not in self.arguments else {}
        model = DreamerV2(
            _policy(env), env,
            **{"intrinsic_reward": start.method, "seed": start.seed, "learn_task_reward": True, **defaults, **self.arguments},
        )  # fmt: skip
        steps = -(-start.lengths[-1] // model.action_repeat)
        keeper = RunCheckpointCallback(folder, resume="auto")
        model.learn(steps, callback=[keeper, SnapshotCallback(last.parent, start.lengths)])
        model.env.close()  # type: ignore[union-attr]
        # The replay is most of it, and nobody needs it now.
        shutil.rmtree(folder)

    def finetune(self, run: FineTuning) -> None:
        """Fine-tune, evaluate, and add the row; goes on where it was cut off.

        :param run: whose pre-training is finished
        """
        env, folder = self.make_env(run.env, 1), self.path / "runs" / run.name.replace("/", "_")
        if isinstance(env, VecNormalize) and run.start.method != SCRATCH:
            # What the model knows of the world, it knows through these.
            env = load_vec_normalize(beside(self.snapshot(run.start, run.length)), env.venv, training=True)
        model = self._begin(run, env)
        if run.frames:
            steps = -(-run.frames // model.action_repeat)
            model.learn(steps, callback=RunCheckpointCallback(folder, resume="auto"))
        target = self.path / "tuned" / f"{run.name}.zip"
        target.parent.mkdir(parents=True, exist_ok=True)
        model.save(target)
        played_in = self.make_env(run.env, min(self.episodes, 10))
        if isinstance(env, VecNormalize):
            save_vec_normalize(env, beside(target))
            sync_envs_normalization(env, played_in)
        played = run_evaluation(model, played_in, self.episodes, planner="off" if run.planner is None else "on")
        columns: dict[str, Any] = {"run_folder": run.name, "known_reward": "true" if run.keep_reward else "false"}
        append_row(self.rows, row_of(model, played_in, played, **columns))
        for one in (env, played_in):
            one.close()
        shutil.rmtree(folder, ignore_errors=True)

    def _begin(self, run: FineTuning, env: VecEnv) -> DreamerV2:
        """The agent with which a fine-tuning begins."""
        if run.start.method == SCRATCH:
            arguments = {**self.arguments, "seed": run.start.seed, "planner": run.planner}
            return DreamerV2(_policy(env), env, **arguments)
        device = self.arguments.get("device", "auto")
        model = DreamerV2.load(self.snapshot(run.start, run.length), env=env, device=device, planner=run.planner)
        model.fine_tune(keep_actor=run.keep_actor, keep_critic=run.keep_critic, keep_reward=run.keep_reward)
        model.num_timesteps = 0
        return model

    # -- all of them ---------------------------------------------------------------------------------------------------

    def work(self, runs: Sequence[FineTuning], minutes: float = float("inf"), at_most: int | None = None) -> int:
        """Do missing runs, each after its pre-training; several processes may work beside each other.

        :param runs: of the study
        :param minutes: begin none after so many
        :param at_most: fine-tunings
        :return: fine-tunings done
        :raises ValueError: if the folder holds runs of other settings
        """
        end, count = time.monotonic() + 60 * minutes, 0
        missing = self.missing(runs)
        remember(self.path, self.settings)
        awaited: list[str] = []
        for run in missing:
            if time.monotonic() > end or count == at_most:
                break
            with self._locked(run.start.name) as mine:
                if mine:
                    self.pretrain(run.start)
                    self._check_there(run)
            if run.start.method != SCRATCH and not self.snapshot(run.start, run.length).exists():
                # Another process is at it.
                awaited.append(f"the pre-training {run.start.name}")
                continue
            with self._locked(run.name) as mine:
                if not mine:
                    awaited.append(run.name)
                elif run.name not in self.finished():
                    self.finetune(run)
                    print(f"{run.name}: done", flush=True)
                    count += 1
        if awaited:
            print(f"Left to other processes, which are at it: {', '.join(dict.fromkeys(awaited))}. Start again after them.")
        elif not missing:
            print("Nothing is missing.")
        return count

    def _check_there(self, run: FineTuning) -> None:
        if run.start.method != SCRATCH and not self.snapshot(run.start, run.length).exists():
            raise ValueError(
                f"{self.path} holds the pre-training {run.start.name} without a snapshot at {run.length} frames: "
                "other lengths need another folder."
            )

    @contextmanager
    def _locked(self, name: str) -> Iterator[bool]:
        """Whether this process has the run now."""
        path = self.path / "runs" / f".{name.replace('/', '_')}.lock"
        path.parent.mkdir(parents=True, exist_ok=True)
        with open(path, "a") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                yield False
            else:
                yield True


def _policy(env: VecEnv) -> str:
    space = env.observation_space
    if isinstance(space, spaces.Dict):
        return "MultiInputPolicy"
    return "CnnPolicy" if isinstance(space, spaces.Box) and len(space.shape) == 3 else "MlpPolicy"


def normalized_states(env_id: str, count: int) -> VecEnv:
    """Environments that show dm_control's own numbers, normalised: cheap enough for CPU cores.

    :param env_id: id
    :param count: how many
    """
    return VecNormalize(make_vec_env(env_id, count, env_kwargs={"observation": "state"}), norm_reward=False)
