"""Learn CartPole-v1 or Pendulum-v1 from vectors on a CPU, and draw the learning curve.

    python benchmarks/vector_tasks.py CartPole-v1 --seeds 0 1 2 --out docs/images

Writes ``<task>.csv`` (agent steps, CPU seconds, return of every episode) and, with matplotlib, ``<task>.png``.
"""

from __future__ import annotations

import argparse
import csv
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize

from sb3_dreamer_urlb import DreamerV2


@dataclass(frozen=True)
class Task:
    """
    :param steps: agent steps of a run
    :param arguments: of the constructor
    :param random: return of random actions
    """

    steps: int
    arguments: dict[str, Any]
    random: float


TASKS = {
    # Random episodes have about 20 steps, and a sequence must fit into one.
    "CartPole-v1": Task(10_000, {"batch_length": 10, "batch_size": 24}, 22.0),
    "Pendulum-v1": Task(12_000, {}, -1200.0),
}


class Curve(BaseCallback):
    """Notes every episode: agent steps, CPU seconds since the start, return."""

    def __init__(self) -> None:
        super().__init__()
        self.rows: list[tuple[int, float, float]] = []
        self.began = time.process_time()

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "episode" in info:
                self.rows.append((self.num_timesteps, time.process_time() - self.began, info["episode"]["r"]))
        return True


def learn(name: str, seed: int, steps: int | None = None) -> tuple[list[tuple[int, float, float]], float]:
    """One run.

    :param name: key of ``TASKS``
    :param seed: of everything
    :param steps: agent steps, the task's own if None
    :return: rows of :class:`Curve`, and the mean return of ten deterministic episodes
    """
    task = TASKS[name]
    env = VecNormalize(make_vec_env(name, 1, seed=seed), norm_reward=False)
    model = DreamerV2("MlpPolicy", env, seed=seed, device="cpu", preset="vector", **task.arguments)
    curve = Curve()
    model.learn(task.steps if steps is None else steps, curve)
    env.training = False
    score, _ = evaluate_policy(model, env, n_eval_episodes=10)
    return curve.rows, float(score)  # type: ignore[arg-type]


def draw(name: str, runs: dict[int, list[tuple[int, float, float]]], path: Path) -> None:
    """Mean of ten episodes over agent steps, a line a seed, and random actions."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(6, 3.5), layout="constrained")
    for seed, rows in runs.items():
        returns = [row[2] for row in rows]
        means = [np.mean(returns[max(0, i - 9) : i + 1]) for i in range(len(returns))]
        axes.plot([row[0] for row in rows], means, label=f"seed {seed}")
    axes.axhline(TASKS[name].random, color="grey", linestyle=":", label="random actions")
    axes.set(title=f"{name}, vectors", xlabel="agent steps", ylabel="return (mean of 10 episodes)")
    axes.legend()
    figure.savefig(path, dpi=110)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", choices=sorted(TASKS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--steps", type=int, help="agent steps (default: the task's own)")
    parser.add_argument("--out", type=Path, default=Path("."))
    options = parser.parse_args()
    gymnasium.spec(options.task)
    th.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    runs = {}
    for seed in options.seeds:
        runs[seed], score = learn(options.task, seed, options.steps)
        print(f"{options.task} seed {seed}: {score:.1f} after {runs[seed][-1][1]:.0f} s of CPU time", flush=True)
    stem = options.task.split("-")[0].lower()
    with open(options.out / f"{stem}.csv", "w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["seed", "steps", "cpu_seconds", "return"])
        writer.writerows((seed, *row) for seed, rows in runs.items() for row in rows)
    draw(options.task, runs, options.out / f"{stem}.png")


if __name__ == "__main__":
    main()
