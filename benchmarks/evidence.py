"""Does pre-training pay? All runs that answer it on CPU cores: does what is missing, and scores it.

    python benchmarks/evidence.py run --minutes 120   # the next missing runs, one after the other, on one thread
    python benchmarks/evidence.py list                # what there is and what is missing
    python benchmarks/evidence_results.py             # what the finished ones say, with intervals and a figure

An agent that sees states (``observation="state"``) explores a body without any reward, the walker or, for a sparse task, the
finger; then it learns a task. Beside it stand agents that learn that task from scratch. Everything lies in
``results/evidence``: ``episodes.csv``, a row for every episode of every finished run; ``rows.csv``, a row for every score
(actor alone, and with Dyna-MPC); ``snapshots/``, the pre-trained agents, from which further fine-tunings start. Runs that are
under way keep themselves in ``runs/`` and go on there when they are asked for again; several processes, each with its own run,
may work beside each other.
"""

from __future__ import annotations

import argparse
import csv
import fcntl
import itertools
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_dreamer_urlb import DreamerV2, RunCheckpointCallback, __version__
from sb3_dreamer_urlb.evaluation.append import append_rows
from sb3_dreamer_urlb.evaluation.rows import Row
from sb3_dreamer_urlb.snapshots.vec_normalize import beside, load_vec_normalize, save_vec_normalize

ROOT = Path(__file__).parents[1] / "results" / "evidence"
PRESET = "state-small"
#: body → the environment of its pre-training, whose reward nobody sees
PRIMAL = {"walker": "stand", "finger": "spin"}
#: task → body, where it is not the walker. Spin pays 1 while the finger spins fast, else 0: random actions get 2 of 1000
BODIES = {"spin": "finger"}
#: any task of dm_control's suite
SUITE = "urlb/dm_control-v0"
#: agent steps; an episode has 500
PRETRAINING, FINETUNING, REPEAT = 20_000, 10_000, 2
#: name of an arm → intrinsic reward of its pre-training (None: from scratch), and whether the actor is kept
ARMS: dict[str, tuple[str | None, bool]] = {
    "scratch": (None, False),
    "lbs-kept": ("lbs", True),
    "lbs-fresh": ("lbs", False),
    "random-fresh": ("random", False),
    "plan2explore-kept": ("plan2explore", True),
}
#: what to run, most telling first: arms, tasks, number of seeds
STUDY: tuple[tuple[tuple[str, ...], tuple[str, ...], int], ...] = (
    (("lbs-kept", "scratch"), ("run", "flip"), 5),
    (("lbs-kept", "scratch"), ("spin",), 3),
    (("random-fresh", "lbs-fresh"), ("run", "flip"), 3),
    (("lbs-kept", "scratch"), ("run", "flip", "spin"), 10),
    (("random-fresh", "lbs-fresh", "plan2explore-kept"), ("run", "flip", "spin"), 10),
)
#: of the evaluation at a run's end
EPISODES, EVALUATION_SEED = 10, 10_000


@dataclass(frozen=True)
class Run:
    """
    :param arm: of ``ARMS``, or the method of a pre-training
    :param task: of the body; ``""`` for the pre-training itself
    :param seed: of everything
    :param body: of ``PRIMAL``
    """

    arm: str
    task: str
    seed: int
    body: str = "walker"

    @property
    def name(self) -> str:
        """Of its folder, and in ``episodes.csv``."""
        body = "" if self.body == "walker" else f"-{self.body}"
        return f"{self.task or f'pretraining{body}'}/{self.arm}/{self.seed}"

    @property
    def needs(self) -> Run | None:
        """The pre-training that it starts from."""
        method, _ = ARMS.get(self.arm, (None, False))
        return Run(method, "", self.seed, self.body) if self.task and method is not None else None


def wanted() -> Iterator[Run]:
    """All runs in order, each after the pre-training that it needs."""
    seen = set()
    for arms, tasks, seeds in STUDY:
        for seed, task, arm in itertools.product(range(seeds), tasks, arms):
            run = Run(arm, task, seed, BODIES.get(task, "walker"))
            for one in (run.needs, run):
                if one is not None and one not in seen:
                    seen.add(one)
                    yield one


# -- one run ---------------------------------------------------------------------------------------------------------------


def make_env(task: str, seed: int, statistics: Path | None = None, training: bool = True, n_envs: int = 1) -> VecNormalize:
    """States of a task, normalised: with the statistics of the pre-training where there was one."""
    body = BODIES.get(task, "walker")
    name, which = (f"urlb/walker-{task}-v0", {}) if body == "walker" else (SUITE, {"domain": body, "task": task})
    env = DummyVecEnv([lambda: Monitor(gymnasium.make(name, observation="state", **which))] * n_envs)
    env.seed(seed)
    if statistics is None:
        return VecNormalize(env, training=training, norm_reward=False)
    normalized = load_vec_normalize(statistics, env, training)
    normalized.norm_reward = False
    return normalized


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


def snapshot_of(pretraining: Run) -> Path:
    """Where a pre-trained agent lies; the statistics of its observations lie beside it."""
    body = "" if pretraining.body == "walker" else f"{pretraining.body}-"
    return ROOT / "snapshots" / f"{body}{pretraining.arm}-{pretraining.seed}.zip"


def begin(run: Run, folder: Path) -> tuple[DreamerV2, int]:
    """A model at the beginning of its run, or where the run was left, and how many agent steps it has in all."""
    method, keep_actor = (run.arm, False) if not run.task else ARMS[run.arm]
    source = None if run.needs is None else snapshot_of(run.needs)
    start = None if source is None else beside(source)
    env = make_env(run.task or PRIMAL[run.body], run.seed if not run.task else 1000 + run.seed, start)
    left = DreamerV2.resume(folder, env, device="cpu")
    if left is not None:
        return left, FINETUNING if run.task else PRETRAINING
    if source is not None:
        model = DreamerV2.load(source, env=env, device="cpu")
        model.fine_tune(keep_actor=keep_actor)
        model.num_timesteps = 0
        return model, FINETUNING
    model = DreamerV2("MlpPolicy", env, preset=PRESET, intrinsic_reward=method, seed=run.seed, device="cpu")
    return model, FINETUNING if run.task else PRETRAINING


def do(run: Run) -> None:
    """From wherever it was left to its end and into the results."""
    folder = ROOT / "runs" / run.name
    folder.mkdir(parents=True, exist_ok=True)
    model, steps = begin(run, folder)
    episodes = Episodes(folder / "episodes.csv")
    began = time.monotonic()
    keeper = RunCheckpointCallback(folder, every_frames=2 * 2500)
    model.learn(steps - model.num_timesteps, callback=[keeper, episodes], reset_num_timesteps=model.num_timesteps == 0)
    env = model.get_vec_normalize_env()
    assert env is not None
    if run.task:
        score(run, model, env, folder)
    else:
        for optimizer in model.learner.optimizers().values():
            # Fine-tuning starts with fresh ones, and they are two thirds of a file.
            optimizer.adam.state.clear()
        path = snapshot_of(run)
        path.parent.mkdir(parents=True, exist_ok=True)
        save_vec_normalize(env, beside(path))
        model.save(path)
    record(run, episodes.rows())
    shutil.rmtree(folder)
    print(f"{run.name}: done, {time.monotonic() - began:.0f} s", flush=True)


def record(run: Run, episodes: list[tuple[int, float]]) -> None:
    """Append a finished run's episodes to the results."""
    with locked(), open(ROOT / "episodes.csv", "a", newline="") as file:
        writer = csv.writer(file)
        if file.tell() == 0:
            writer.writerow(["run", "step", "return"])
        writer.writerows((run.name, step, f"{score:.3f}") for step, score in episodes)


def score(run: Run, model: DreamerV2, env: VecNormalize, folder: Path) -> None:
    """Ten episodes with the actor alone and ten with Dyna-MPC, each from a start of its own and all at once, as rows."""
    save_vec_normalize(env, beside(folder / "final.zip"))
    model.save(folder / "final.zip")
    method, keep_actor = ARMS[run.arm]
    rows = []
    for planner in (None, "dyna_mpc"):
        unseen = make_env(run.task, EVALUATION_SEED + EPISODES * run.seed, beside(folder / "final.zip"), False, EPISODES)
        agent = DreamerV2.load(folder / "final.zip", env=unseen, device="cpu", planner=planner)
        began = time.monotonic()
        returns, _ = evaluate_policy(agent, unseen, EPISODES, return_episode_rewards=True)
        rows.append(
            Row(
                method=method or "dreamer",
                domain=run.body,
                task=run.task,
                seed=run.seed,
                pretrain_frames=0 if method is None else PRETRAINING * REPEAT,
                finetune_frames=FINETUNING * REPEAT,
                keep_actor=None if method is None else keep_actor,
                keep_critic=None if method is None else False,
                planner=planner or "none",
                preset=PRESET,
                return_mean=float(np.mean(returns)),
                return_std=float(np.std(returns)),
                episodes=EPISODES,
                seconds=time.monotonic() - began,
                further={"observation": "state", "arm": run.arm, "algorithm_version": __version__},
            )
        )
    append_rows(ROOT / "rows.csv", rows)


# -- the campaign ------------------------------------------------------------------------------------------------------------


@contextmanager
def locked(name: str = "lock", wait: bool = True) -> Iterator[bool]:
    """Whether this process has it now."""
    path = ROOT / "runs" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "a") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            yield False
        else:
            yield True


def curves() -> dict[str, list[tuple[int, float]]]:
    """Episodes of the finished runs, by name."""
    found: dict[str, list[tuple[int, float]]] = {}
    path = ROOT / "episodes.csv"
    if path.exists():
        with open(path, newline="") as file:
            for row in csv.DictReader(file):
                found.setdefault(row["run"], []).append((int(row["step"]), float(row["return"])))
    return found


def work(minutes: float, at_most: int | None, body: str | None = None) -> None:
    """Do missing runs until the time is up; one that is under way then is stopped and kept by a signal, or a kill.

    :param minutes: after which no run is begun
    :param at_most: runs
    :param body: whose, None for all
    """
    end, count = time.monotonic() + 60 * minutes, 0
    for run in wanted():
        if time.monotonic() > end or count == at_most:
            return
        if body not in (None, run.body) or run.name in curves() or (run.needs is not None and run.needs.name not in curves()):
            continue
        with locked(run.name.replace("/", "-") + ".lock", wait=False) as mine:
            if mine and run.name not in curves():
                do(run)
                count += 1


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    run = commands.add_parser("run", help="do missing runs")
    run.add_argument("--minutes", type=float, default=float("inf"), help="begin no run after so many")
    run.add_argument("--at-most", type=int, help="runs")
    run.add_argument("--body", choices=PRIMAL, help="whose (default: all)")
    commands.add_parser("list", help="all runs, and which are done")
    options: Any = parser.parse_args()
    th.set_num_threads(1)
    if options.command == "run":
        work(options.minutes, options.at_most, options.body)
    else:
        done = curves()
        for one in wanted():
            print("done   " if one.name in done else "missing", one.name)


if __name__ == "__main__":
    main()
