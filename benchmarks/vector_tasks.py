"""Learn CartPole-v1 or Pendulum-v1 from vectors on a CPU, and draw the learning curves.

    python benchmarks/vector_tasks.py CartPole-v1 --seeds 0 1 2 --out docs/images

The hyperparameters are those of zoo_configs/vectors.yml. Each seed writes <task>_<seed>.csv (agent steps, CPU seconds
and return of every episode); <task>.png shows all that lie there (matplotlib).
"""

from __future__ import annotations

import argparse
import csv
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
import yaml
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecNormalize

from sb3_dreamer_urlb import DreamerV2
from sb3_dreamer_urlb.output_reader import ending_with_its_reader

CONFIG = Path(__file__).parents[1] / "zoo_configs" / "vectors.yml"
#: mean return of 100 episodes of random actions
RANDOM = {"CartPole-v1": 22.0, "Pendulum-v1": -1200.0}


@dataclass
class Run:
    """
    :param rows: agent steps, CPU seconds since the start and return of every episode
    :param scores: returns of deterministic episodes at the end
    :param seconds: CPU time of training
    """

    rows: list[tuple[int, float, float]]
    scores: np.ndarray
    seconds: float


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


def settings(task: str) -> tuple[int, dict[str, Any]]:
    """Agent steps and constructor arguments of a task in ``zoo_configs/vectors.yml``."""
    entry = dict(yaml.safe_load(CONFIG.read_text())[task])
    # rl_zoo3's "normalize" is SB3's VecNormalize, see learn().
    assert entry.pop("normalize") is True
    del entry["checkpoint"]  # the zoo's
    return entry.pop("n_timesteps"), entry


def learn(task: str, seed: int, steps: int | None = None, episodes: int = 20, **changes: Any) -> Run:
    """One run.

    :param task: CartPole-v1 or Pendulum-v1
    :param seed: of everything
    :param steps: agent steps, the task's own if None
    :param episodes: of the evaluation, with other starts than those of training
    :param changes: constructor arguments to replace
    """
    default_steps, arguments = settings(task)
    env = VecNormalize(make_vec_env(task, 1, seed=seed))
    model = DreamerV2(env=env, seed=seed, device="cpu", **{**arguments, **changes})
    curve = Curve()
    model.learn(default_steps if steps is None else steps, curve)
    seconds = time.process_time() - curve.began
    unseen = VecNormalize(make_vec_env(task, 1, seed=seed + 1000), training=False)
    unseen.obs_rms = env.obs_rms
    scores, _ = evaluate_policy(model, unseen, n_eval_episodes=episodes, return_episode_rewards=True)
    return Run(curve.rows, np.array(scores), seconds)


def draw(task: str, folder: Path) -> None:
    """Mean of ten episodes over agent steps, a line a seed, and random actions."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(6, 3.5), layout="constrained")
    for path in sorted(folder.glob(f"{stem(task)}_*.csv")):
        steps, _, returns = np.loadtxt(path, delimiter=",", skiprows=1, unpack=True)
        means = [returns[max(0, i - 9) : i + 1].mean() for i in range(len(returns))]
        axes.plot(steps, means, label=f"seed {path.stem.split('_')[1]}")
    axes.axhline(RANDOM[task], color="grey", linestyle=":", label="random actions")
    axes.set(title=f"{task}, vectors", xlabel="agent steps", ylabel="return (mean of 10 episodes)")
    axes.legend()
    figure.savefig(folder / f"{stem(task)}.png", dpi=110)


def stem(task: str) -> str:
    """Of a task's files."""
    return task.split("-")[0].lower()


@ending_with_its_reader()
def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", choices=sorted(RANDOM))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--steps", type=int, help="agent steps (default: the task's own)")
    parser.add_argument("--episodes", type=int, default=20, help="of the evaluation at the end (default: 20)")
    parser.add_argument("--out", type=Path, default=Path("."))
    options = parser.parse_args()
    th.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    for seed in options.seeds:
        run = learn(options.task, seed, options.steps, options.episodes)
        with open(options.out / f"{stem(options.task)}_{seed}.csv", "w", newline="") as file:
            writer = csv.writer(file)
            writer.writerow(["steps", "cpu_seconds", "return"])
            writer.writerows((steps, f"{seconds:.1f}", f"{score:.1f}") for steps, seconds, score in run.rows)
        print(
            f"{options.task} seed {seed}: {run.scores.mean():.1f} ± {run.scores.std():.1f}, worst {run.scores.min():.1f}, "
            f"after {run.seconds:.0f} s of CPU time",
            flush=True,
        )
    draw(options.task, options.out)


if __name__ == "__main__":
    main()
