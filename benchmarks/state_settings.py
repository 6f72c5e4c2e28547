"""Which settings learn from states on one CPU core? Short runs of the walker from scratch, as rows.

    python benchmarks/state_settings.py run --minutes 60      # the next missing runs, one thread
    python benchmarks/state_settings.py table                 # what they say

Each setting is a preset and changes to it; each run has one seed and learns walk or run for 10 000 agent steps (20
episodes) without a pre-training. One seed tells settings apart that fail, not those that are alike. Rows lie in
results/state_settings.csv.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_dreamer_urlb import DreamerV2
from sb3_dreamer_urlb.output_reader import ending_with_its_reader

FILE = Path(__file__).parents[1] / "results" / "state_settings.csv"
STEPS = 10_000
TASKS = ("walk", "run")
#: name → preset, and what is changed; most telling first
SETTINGS: dict[str, tuple[str, dict[str, Any]]] = {
    "state-small": ("state-small", {}),
    "KL × 1": ("state-small", {"kl_scale": 1.0}),
    "update every 10 steps": ("state-small", {"train_freq": 10}),
    "actor's rate 8e-5": ("state-small", {"actor_learning_rate": 8e-5}),
    "free nats 1": ("state-small", {"free_nats": 1.0}),
    "KL × 0.01": ("state-small", {"kl_scale": 0.01}),
    "entropy bonus 1e-4": ("state-small", {"ent_coef": 1e-4}),
}
#: the paper's sizes: a run takes half an hour and more, so only where it is asked for by name
LARGE: dict[str, tuple[str, dict[str, Any]]] = {"state": ("state", {})}
RANDOM = "random actions"
#: a run's last episodes, whose mean is its score
LAST = 5


class Result(NamedTuple):
    """One run.

    :param setting: of ``SETTINGS`` or ``LARGE``, or ``RANDOM``
    :param task: of the walker
    :param seed: of everything
    :param steps: agent steps
    :param seconds: CPU time
    :param returns: of its training episodes, in their order
    """

    setting: str
    task: str
    seed: int
    steps: int
    seconds: float
    returns: tuple[float, ...]

    @property
    def score(self) -> float:
        """Mean return of the last episodes."""
        return float(np.mean(self.returns[-LAST:]))


def learn(setting: str, task: str, seed: int, steps: int) -> Result:
    """One run, or random actions for as long."""
    monitored = make_vec_env(f"urlb/walker-{task}-v0", seed=seed, env_kwargs={"observation": "state"})
    env = VecNormalize(monitored, norm_reward=False)
    preset, changes = {**SETTINGS, **LARGE}.get(setting, ("tiny", {"learning_starts": steps}))
    model = DreamerV2("MlpPolicy", env, preset=preset, seed=seed, device="cpu", intrinsic_reward=None, **changes)
    began = time.process_time()
    model.learn(steps)
    seconds = time.process_time() - began
    [returns] = monitored.env_method("get_episode_rewards")
    return Result(setting, task, seed, steps, seconds, tuple(returns))


def read() -> list[Result]:
    """All that were done."""
    if not FILE.exists():
        return []
    with open(FILE, newline="") as file:
        return [
            Result(
                *(row["setting"], row["task"], int(row["seed"]), int(row["steps"]), float(row["cpu_seconds"])),
                tuple(map(float, row["returns"].split())),
            )
            for row in csv.DictReader(file)
        ]


def write(result: Result) -> None:
    """Append."""
    FILE.parent.mkdir(exist_ok=True)
    with open(FILE, "a", newline="") as file:
        writer = csv.writer(file)
        if file.tell() == 0:
            writer.writerow(["setting", "task", "seed", "steps", "cpu_seconds", "returns"])
        numbers = " ".join(f"{value:.1f}" for value in result.returns)
        writer.writerow([*result[:4], f"{result.seconds:.0f}", numbers])


def wanted(settings: list[str], tasks: list[str], seeds: list[int], steps: int) -> Iterator[tuple[str, str, int, int]]:
    """Runs that are not done, in order."""
    done = {result[:4] for result in read()}
    for seed, setting, task in itertools.product(seeds, settings, tasks):
        if (setting, task, seed, steps) not in done:
            yield setting, task, seed, steps


def table() -> str:
    """A row a setting and length, Markdown."""
    lines = [f"| setting | steps | {' | '.join(TASKS)} | CPU time of a run |", f"|---|---|{'---|' * len(TASKS)}---|"]
    results = read()
    for setting, steps in dict.fromkeys((result.setting, result.steps) for result in results):
        own = [result for result in results if (result.setting, result.steps) == (setting, steps)]
        cells = (", ".join(f"{result.score:.0f}" for result in own if result.task == task) for task in TASKS)
        seconds = np.mean([result.seconds for result in own])
        lines.append(f"| {setting} | {steps} | {' | '.join(cells)} | {seconds:.0f} s |")
    return "\n".join(lines)


@ending_with_its_reader()
def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    run = commands.add_parser("run", help="do missing runs")
    run.add_argument("--minutes", type=float, default=float("inf"), help="begin no run after so many")
    run.add_argument("--settings", nargs="+", choices=[*SETTINGS, *LARGE, RANDOM], help="which (default: all small ones)")
    run.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    run.add_argument("--seeds", type=int, nargs="+", default=[0])
    run.add_argument("--steps", type=int, default=STEPS, help="agent steps of a run (default: %(default)s)")
    commands.add_parser("table", help="print the table of what was done")
    options = parser.parse_args()
    th.set_num_threads(1)
    if options.command == "table":
        print(table())
        return
    end = time.monotonic() + 60 * options.minutes
    for one in wanted(options.settings or [RANDOM, *SETTINGS], options.tasks, options.seeds, options.steps):
        if time.monotonic() > end:
            return
        result = learn(*one)
        write(result)
        print(f"{result.setting}, {result.task}, seed {result.seed}: {result.score:.0f}, {result.seconds:.0f} s", flush=True)


if __name__ == "__main__":
    main()
