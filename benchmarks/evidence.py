"""Does pre-training pay? All runs that answer it: does what is missing, and scores it.

    python benchmarks/evidence.py run --minutes 120      # the next missing runs, one after the other, on one thread
    python benchmarks/evidence.py run --setting pixels   # from pictures, slower; "paper": at the paper's size, on a GPU
    python benchmarks/evidence.py list                   # what there is and what is missing
    python benchmarks/evidence_results.py                # what the finished ones say, with intervals and a figure

An agent explores a body without any reward, the walker or, for a sparse task, the finger; then it learns a task. Beside it
stand agents that learn that task from scratch. Which runs there are, and how large: evidence_study.py. Everything lies in
results/evidence: episodes.csv, a row for every episode of every finished run; rows.csv, a row for every score
(actor alone, and with Dyna-MPC); snapshots/, the pre-trained agents, from which further fine-tunings start. Runs that are
under way keep themselves in runs/ and go on there when they are asked for again; several processes, each with its own run,
may work beside each other.
"""

from __future__ import annotations

import argparse
import csv
import fcntl
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import evidence_study as study
import gymnasium
import numpy as np
import torch as th
from evidence_study import ARMS, BODIES, PRIMAL, REPEAT, Arm, Run, Setting, snapshot_of
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize

from sb3_dreamer_urlb import DreamerV2, RunCheckpointCallback, __version__
from sb3_dreamer_urlb.evaluation.append import append_rows
from sb3_dreamer_urlb.evaluation.rows import Row
from sb3_dreamer_urlb.output_reader import ending_with_its_reader
from sb3_dreamer_urlb.snapshots.vec_normalize import beside, load_vec_normalize, save_vec_normalize

#: any task of dm_control's suite
SUITE = "urlb/dm_control-v0"
#: of the evaluation at a run's end
EPISODES, EVALUATION_SEED = 10, 10_000


# -- one run ---------------------------------------------------------------------------------------------------------------


def make_env(
    setting: Setting, task: str, seed: int, snapshot: Path | None = None, training: bool = True, n_envs: int = 1
) -> VecEnv:
    """A task as a setting's agents see it; states normalised with the statistics beside the snapshot where there is one."""
    body = BODIES.get(task, "walker")
    name, which = (f"urlb/walker-{task}-v0", {}) if body == "walker" else (SUITE, {"domain": body, "task": task})
    env = DummyVecEnv([lambda: Monitor(gymnasium.make(name, observation=setting.observation, **which))] * n_envs)
    env.seed(seed)
    if not setting.normalized:
        return env
    if snapshot is None:
        return VecNormalize(env, training=training, norm_reward=False)
    normalized = load_vec_normalize(beside(snapshot), env, training)
    normalized.norm_reward = False
    return normalized


def keep(model: DreamerV2, path: Path) -> None:
    """A snapshot, and beside it the statistics that its agent needs."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if (env := model.get_vec_normalize_env()) is not None:
        save_vec_normalize(env, beside(path))
    model.save(path)


class Episodes(BaseCallback):
    """Writes agent step and return of every episode into a file; what a resumed run does again counts once."""

    def __init__(self, path: Path):
        super().__init__()
        self.path = path

    def rows(self) -> list[tuple[int, float]]:
        """All that is known."""
        if not self.path.exists():
            return []
        lines = (line.split(",") for line in self.path.read_text().splitlines())
        return sorted({int(step): float(score) for step, score in lines}.items())

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "episode" in info:
                with open(self.path, "a") as file:
                    file.write(f"{self.model.phase_timesteps},{info['episode']['r']:.3f}\n")  # type: ignore[union-attr]
        return True


def begin(run: Run, folder: Path) -> DreamerV2:
    """A model at the beginning of its run, or where the run was left."""
    setting = run.setting
    arm = ARMS[run.arm] if run.task else Arm(run.arm)
    source = None if run.needs is None else snapshot_of(run.needs)
    env = make_env(setting, run.task or PRIMAL[run.body], run.seed if not run.task else 1000 + run.seed, source)
    left = DreamerV2.resume(folder, env, device=setting.device)
    if left is not None:
        return left
    if source is not None:
        model = DreamerV2.load(source, env=env, device=setting.device, **arm.changes)
        model.fine_tune(keep_actor=arm.keeps_actor)
        model.num_timesteps = 0
        return model
    kwargs: dict[str, Any] = {"preset": setting.preset, "seed": run.seed, "device": setting.device, **setting.further}
    return DreamerV2(setting.policy, env, intrinsic_reward=arm.method, **kwargs)


def do(run: Run) -> None:
    """From wherever it was left to its end and into the results."""
    folder = study.ROOT / "runs" / run.name
    folder.mkdir(parents=True, exist_ok=True)
    model = begin(run, folder)
    episodes = Episodes(folder / "episodes.csv")
    began = time.monotonic()
    keeper = RunCheckpointCallback(folder, every_frames=2 * 2500)
    model.learn(run.steps - model.num_timesteps, callback=[keeper, episodes], reset_num_timesteps=model.num_timesteps == 0)
    if run.task:
        score(run, model, folder)
    else:
        for optimizer in model.learner.optimizers().values():
            # Fine-tuning starts with fresh ones, and they are two thirds of a file.
            optimizer.adam.state.clear()
        keep(model, snapshot_of(run))
    record(run, episodes.rows())
    shutil.rmtree(folder)
    print(f"{run.name}: done, {time.monotonic() - began:.0f} s", flush=True)


def record(run: Run, episodes: list[tuple[int, float]]) -> None:
    """Append a finished run's episodes to the results."""
    with locked(), open(study.ROOT / "episodes.csv", "a", newline="") as file:
        writer = csv.writer(file)
        if file.tell() == 0:
            writer.writerow(["run", "step", "return"])
        writer.writerows((run.name, step, f"{score:.3f}") for step, score in episodes)


def score(run: Run, model: DreamerV2, folder: Path) -> None:
    """Ten episodes with the actor alone and ten with Dyna-MPC, each from a start of its own and all at once, as rows."""
    setting, final = run.setting, folder / "final.zip"
    keep(model, final)
    arm = ARMS[run.arm]
    rows = []
    for planner in (None, "dyna_mpc"):
        unseen = make_env(setting, run.task, EVALUATION_SEED + EPISODES * run.seed, final, False, EPISODES)
        agent = DreamerV2.load(final, env=unseen, device=setting.device, planner=planner)
        began = time.monotonic()
        returns, _ = evaluate_policy(agent, unseen, EPISODES, return_episode_rewards=True)
        rows.append(
            Row(
                method=arm.method or "dreamer",
                domain=run.body,
                task=run.task,
                seed=run.seed,
                pretrain_frames=0 if arm.method is None else setting.pretraining * REPEAT,
                finetune_frames=setting.finetuning * REPEAT,
                keep_actor=None if arm.method is None else arm.keeps_actor,
                keep_critic=None if arm.method is None else False,
                planner=planner or "none",
                preset=setting.preset,
                return_mean=float(np.mean(returns)),
                return_std=float(np.std(returns)),
                episodes=EPISODES,
                seconds=time.monotonic() - began,
                further={"observation": setting.observation, "arm": run.arm, "algorithm_version": __version__},
            )
        )
    append_rows(study.ROOT / "rows.csv", rows)


# -- the campaign ------------------------------------------------------------------------------------------------------------


@contextmanager
def locked(name: str = "lock", wait: bool = True) -> Iterator[bool]:
    """Whether this process has it now."""
    path = study.ROOT / "runs" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            yield False
        else:
            yield True


def work(minutes: float, at_most: int | None, body: str | None = None, size: str = "state") -> None:
    """Do missing runs until the time is up; one that is under way then is stopped and kept by a signal, or a kill.

    :param minutes: after which no run is begun
    :param at_most: runs
    :param body: whose, None for all
    :param size: of ``study.SETTINGS``
    """
    end, count = time.monotonic() + 60 * minutes, 0
    for run in study.wanted(size):
        if time.monotonic() > end or count == at_most:
            return
        done = study.curves()
        if body not in (None, run.body) or run.name in done or (run.needs is not None and run.needs.name not in done):
            continue
        with locked(run.name.replace("/", "-") + ".lock", wait=False) as mine:
            if mine and run.name not in study.curves():
                do(run)
                count += 1


@ending_with_its_reader()
def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    run = commands.add_parser("run", help="do missing runs")
    run.add_argument("--minutes", type=float, default=float("inf"), help="begin no run after so many")
    run.add_argument("--at-most", type=int, help="runs")
    run.add_argument("--body", choices=PRIMAL, help="whose (default: all)")
    listing = commands.add_parser("list", help="all runs, and which are done")
    for command in (run, listing):
        command.add_argument("--setting", choices=study.SETTINGS, default="state", help="what the agents see (default: state)")
    options: Any = parser.parse_args()
    if study.SETTINGS[options.setting].device == "cpu":
        th.set_num_threads(1)
    if options.command == "run":
        work(options.minutes, options.at_most, options.body, options.setting)
    else:
        done = study.curves()
        for one in study.wanted(options.setting):
            print("done   " if one.name in done else "missing", one.name)


if __name__ == "__main__":
    main()
