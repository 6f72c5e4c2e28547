"""A short pre-training and fine-tuning on a real environment, and where their time goes: python benchmarks/end_to_end.py.

Each phase runs in a process of its own, whose peak memory is its own, too; fine-tuning begins from the snapshot that
pre-training saved. What is timed are windows of one update and the agent steps that belong to it (train_freq), planner on
in fine-tuning. The floor of a window is dm_control alone for as many steps, and the arithmetic of update and plans as big
matrix products: the authors' at paper size (2.4 TFLOP and 195 GFLOP), at other sizes what torch counts of ours.

The projection is S · (environment + acting + replay + other) + (S / episode) · reset + U · (sample + update) + P · planning,
with S = frames / action repeat agent steps, U = (S − learning_starts) / train_freq updates, and P = S − learning_starts −
planner_delay planned steps, all of the preset.
"""

from __future__ import annotations

import argparse
import functools
import json
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import planner
import torch as th
import update
from collect import REPEAT, BareLoop
from common import Product, machine, parser, peak_rss, seconds, set_threads, tflop, write_json
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.utils import get_device
from stable_baselines3.common.vec_env import DummyVecEnv
from stopwatch import OTHER, Stopwatch

from sb3_dreamer_urlb import DreamerV2
from sb3_dreamer_urlb.algorithm.advice import NoUpdateWarning
from sb3_dreamer_urlb.envs import DOMAINS, PRIMAL_TASK, URLB_TASKS, SupervisedVecEnv, make_urlb_env
from sb3_dreamer_urlb.output_reader import ending_with_its_reader

ENV, ACTING, PLANNING, ADD, SAMPLE, UPDATE = "environment", "acting", "planning", "replay add", "replay sample", "update"
PARTS = (ENV, ACTING, PLANNING, ADD, SAMPLE, UPDATE, OTHER)
#: the paper's frames
PHASES = {"pre-training": 2_000_000, "fine-tuning": 100_000}
#: windows before those that count
WARM_UP = 2
GB = 1e9


def make_env(domain: str, task: str, length: int) -> gymnasium.Env[Any, Any]:
    """A task with short episodes: none ends within the windows."""
    return gymnasium.wrappers.TimeLimit(make_urlb_env(domain, task, action_repeat=REPEAT), length)


def make_phase(options: argparse.Namespace) -> tuple[DreamerV2, dict[str, int]]:
    """The model at the beginning of a phase, with shortened warm-ups.

    :return: it, and the preset's own numbers, of which a projection is made
    """
    task = PRIMAL_TASK[options.domain] if options.only == "pre-training" else URLB_TASKS[options.domain][-1]
    n, kind = options.environments, SupervisedVecEnv if options.environments > 1 else DummyVecEnv
    length = {"tiny": 40, "small": 80}.get(options.preset, 100)
    env = kind([functools.partial(make_env, options.domain, task, length)] * n)
    if options.only == "pre-training":
        kwargs: dict[str, Any] = {"intrinsic_reward": "lbs", "planner": "dyna_mpc", "precision": options.precision[0]}
        kwargs.update(gradient_steps=n, preset=options.preset, device=options.device, seed=0)
        model = DreamerV2("CnnPolicy", env, **kwargs)
    else:
        model = DreamerV2.load(options.snapshot, env, device=options.device)
        with warnings.catch_warnings():
            # How long it takes does not depend on what was learnt.
            warnings.simplefilter("ignore", NoUpdateWarning)
            model.fine_tune()
    own = {name: getattr(model, name) for name in ("learning_starts", "planner_delay", "buffer_size")}
    own["train_freq"] = model.train_freq.frequency  # type: ignore[union-attr]
    if options.only == "pre-training":
        Path(options.snapshot + ".json").write_text(json.dumps(own))
    else:
        own = json.loads(Path(options.snapshot + ".json").read_text())
    model.learning_starts, model.planner_delay = length * n, 0
    return model, own


class Windows(BaseCallback):
    """Times from the beginning of one rollout to that of the next: some steps and their update.

    :param watch: that tells the parts
    :param floors: name → what to time between the windows
    :param clock: for the floors
    """

    def __init__(self, watch: Stopwatch, options: argparse.Namespace):
        super().__init__()
        self.watch, self.options = watch, options
        self.windows: list[dict[str, float]] = []
        self.floors: dict[str, list[float]] = {}
        self.peak = self.before = 0

    def _on_step(self) -> bool:
        return True

    def _on_rollout_start(self) -> None:
        assert isinstance(self.model, DreamerV2)
        self._close()
        if self.model.phase_updates == 0:
            self.before = peak_rss()
        if self.model.phase_updates < WARM_UP * self.model.gradient_steps:
            return
        if not self.floors:
            # Before the floors' own memory.
            self.peak = peak_rss()
            self.bare = BareLoop(self.options.domain)
            self.bare.reset()
            formats = {UPDATE: self.model.learner.dtype, PLANNING: th.bfloat16}
            products = {part: Product(dtype, self.model.device) for part, dtype in formats.items()}
            self.formats = {part: big.name for part, big in products.items()}
            self.products = {big.name: big for big in products.values()}
        floors: dict[str, Callable[[], object]] = {ENV: self.bare.step, **self.products}
        for name, work in floors.items():
            warm_up = 0 if name in self.floors else 1
            found = seconds(work, 1, self.model.device, self.options.clock, warm_up)
            self.floors.setdefault(name, []).extend(found)
        self.watch.start()

    def _on_training_end(self) -> None:
        self._close()

    def _close(self) -> None:
        if self.watch.running:
            self.windows.append(self.watch.stop())


def watch_parts(model: DreamerV2, watch: Stopwatch) -> None:
    """Let a stopwatch see what the model does."""
    policy = model.policy
    for method in ("step_async", "step_wait"):
        watch.watch(model.env, method, ENV)
    watch.watch(policy, "observe", ACTING)
    watch.watch(policy, "choose", lambda: PLANNING if policy.planning else ACTING)
    watch.watch(model.replay_buffer, "add", ADD)
    watch.watch(model.replay_buffer, "sample", SAMPLE)
    watch.watch(model.learner, "update", UPDATE)


def run_phase(options: argparse.Namespace) -> dict[str, Any]:
    """One phase, in this process."""
    set_threads(options)
    model, own = make_phase(options)
    if options.only == "pre-training":
        model.save(options.snapshot)
    assert model.env is not None
    frequency = own["train_freq"]
    watch = Stopwatch(options.clock, model.device)
    windows = Windows(watch, options)
    watch_parts(model, watch)
    steps = model.learning_starts + (WARM_UP + options.repeat) * frequency * model.n_envs
    model.learn(steps, windows)
    return {
        "windows": windows.windows,
        "floors": windows.floors,
        "tflop": arithmetic(model, options),
        "reset": min(seconds(model.env.reset, 2, model.device, options.clock, warm_up=0)),
        "memory": {"before": windows.before, "peak": windows.peak, "row": model.replay_buffer.row_bytes()},
        "steps": frequency * model.n_envs,
        "products": windows.formats,
        "own": own,
    }


def arithmetic(model: DreamerV2, options: argparse.Namespace) -> dict[str, float]:
    """TFLOP of a window's updates and of an agent step's plan."""
    plans = options.only == "fine-tuning"
    if options.preset == "paper":
        found = update.TFLOP, planner.TFLOP * plans
    else:
        batch = model.replay_buffer.sample(model.batch_size)
        images = model.env.reset()  # type: ignore[union-attr]
        found = tflop(lambda: model.learner.update(batch)), tflop(lambda: model.predict(images)) * plans  # type: ignore[arg-type]
    return {UPDATE: found[0] * model.gradient_steps, PLANNING: found[1]}


def in_process(phase: str, precision: str, snapshot: str, options: argparse.Namespace) -> dict[str, Any]:
    """A phase in a process of its own."""
    words = ["--only", phase, "--snapshot", snapshot, "--precision", precision]
    for name in ("preset", "repeat", "threads", "clock", "device", "domain", "environments"):
        if getattr(options, name) is not None:
            words += [f"--{name}", str(getattr(options, name))]
    words = ["--quick", *words] if options.quick else words
    done = subprocess.run([sys.executable, __file__, *words], check=True, stdout=subprocess.PIPE, text=True)
    result = json.loads(done.stdout.splitlines()[-1])
    assert isinstance(result, dict)
    return result


def summary(phase: str, found: dict[str, Any], episode: int) -> dict[str, Any]:
    """What a phase's best window says, in seconds an agent step.

    :param phase: key of ``PHASES``
    :param found: by ``run_phase``
    :param episode: agent steps of an episode
    """
    best = min(found["windows"], key=lambda window: sum(window.values()))
    parts = {part: best.get(part, 0.0) / found["steps"] for part in PARTS}
    floor = {name: min(times) for name, times in found["floors"].items()}
    product = {name: time / Product.TFLOP for name, time in floor.items() if name != ENV}
    floors = {
        ENV: floor[ENV],
        UPDATE: found["tflop"][UPDATE] * product[found["products"][UPDATE]] / found["steps"],
        PLANNING: found["tflop"][PLANNING] * product[found["products"][PLANNING]],
    }
    own, total = found["own"], sum(parts.values())
    agent_steps = PHASES[phase] / REPEAT
    updates = (agent_steps - own["learning_starts"]) / own["train_freq"]
    planned = agent_steps - own["learning_starts"] - own["planner_delay"] if phase == "fine-tuning" else 0
    projected = (
        agent_steps * (parts[ENV] + parts[ACTING] + parts[ADD] + parts[OTHER] + found["reset"] / episode)
        + updates * own["train_freq"] * (parts[SAMPLE] + parts[UPDATE])
        + planned * parts[PLANNING]
    )
    memory = found["memory"]
    rows = min(own["buffer_size"], agent_steps * (1 + 1 / episode))
    return {
        "ratio": total / sum(floors.values()),
        "ratios": {part: parts[part] / floors[part] for part in floors if floors[part]},
        "frames/s": REPEAT / total,
        "seconds a step": parts,
        "shares": {part: parts[part] / total for part in PARTS},
        "projected hours": projected / 3600,
        "reset seconds": found["reset"],
        "peak GB": memory["peak"] / GB,
        "peak GB with a full replay": (memory["peak"] + rows * memory["row"]) / GB,
        "GB before the first update": memory["before"] / GB,
        "products": found["products"],
        **found,
    }


def show(row: str, result: dict[str, Any]) -> None:
    """One phase's part of the table."""
    memory = (
        f"peak memory {result['peak GB']:.2f} GB, {result['GB before the first update']:.2f} before the first update, "
        f"{result['peak GB with a full replay']:.2f} with a full replay in memory"
    )
    print(f"  {result['ratio']:6.2f} × floor  {row}: {result['frames/s']:.4g} frames/s, update in {result['products']}")
    print(f"  {result['frames']:>16} frames take {result['projected hours']:.3g} hours; {memory}")
    for part in PARTS:
        ratio = f"{result['ratios'][part]:6.2f} ×" if part in result["ratios"] else " " * 8
        print(
            f"  {ratio}        {part:<14} {result['shares'][part]:6.1%}  {result['seconds a step'][part]:.4g} s an agent step"
        )


@ending_with_its_reader()
def main() -> None:
    """Run each phase in each format and print where its time goes."""
    choice = parser(__doc__)
    choice.set_defaults(precision=["auto"])
    choice.add_argument("--domain", default="walker", choices=DOMAINS)
    choice.add_argument("--environments", type=int, default=1, help="more than one run in processes: wall time then")
    choice.add_argument("--only", choices=PHASES, help="this phase, in this process; prints JSON")
    choice.add_argument("--snapshot", help="of --only: where pre-training saves, and fine-tuning begins")
    options = choice.parse_args()
    if options.only:
        print(json.dumps(run_phase(options)))
        return
    set_threads(options)
    episode = {"jaco": 125}.get(options.domain, 500)
    results: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for precision in options.precision:
            for phase in PHASES:
                found = in_process(phase, precision, f"{folder}/{precision}.zip", options)
                results[f"{phase}, {options.domain}, {precision}"] = {
                    "frames": PHASES[phase],
                    **summary(phase, found, episode),
                }
    about = machine(options, get_device(options.device))
    if write_json({"benchmark": "end_to_end", **about, "phases": results}, options):
        return
    print(f"end_to_end: {', '.join(f'{key} {value}' for key, value in about.items())}")
    for row, result in results.items():
        show(row, result)


if __name__ == "__main__":
    main()
