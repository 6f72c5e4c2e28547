"""Every exploration method once: pre-train, save, load, fine-tune, and a table of what was seen."""

from __future__ import annotations

import math
import multiprocessing
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter, Logger

from sb3_dreamer_urlb.dreamer_v2 import DreamerV2
from sb3_dreamer_urlb.dreamer_v2.presets import get_preset
from sb3_dreamer_urlb.evaluation.protocol import RandomPolicy, evaluate
from sb3_dreamer_urlb.evaluation.scores import oracle
from sb3_dreamer_urlb.folders import made_folder
from sb3_dreamer_urlb.intrinsic import IntrinsicReward, make_intrinsic_reward, registered_intrinsic_rewards
from sb3_dreamer_urlb.number_checks import check_positive

COLUMNS = ("method", "updates", "intrinsic reward", "spread", "module's loss", "fine-tuned", "minutes", "")


@dataclass(frozen=True)
class TourConfig:
    """What the tour does; the defaults take about 4 minutes a method on one core.

    :param out: folder of the snapshots
    :param methods: which, all registered ones if empty
    :param task: pre-training and fine-tuning task, ``<domain>-<task>``
    :param pretrain_frames: environment frames of pre-training
    :param finetune_frames: environment frames of fine-tuning
    :param episodes: evaluation episodes
    :param seed: of everything random
    :param preset: of the model
    :param jobs: methods at a time, one thread each
    :param log_every: agent steps between two records
    :raises ValueError: for an unknown method, task or preset, or a number that is not positive
    """

    out: Path = Path("methods_output")
    methods: tuple[str, ...] = ()
    task: str = "walker-stand"
    pretrain_frames: int = 4000
    finetune_frames: int = 3000
    episodes: int = 2
    seed: int = 0
    preset: str = "small"
    jobs: int = 2
    log_every: int = 100

    def __post_init__(self) -> None:
        oracle(self.task)
        get_preset(self.preset)
        known: dict[str, type[IntrinsicReward]] = registered_intrinsic_rewards()
        unknown = sorted(set(self.methods) - set(known))
        if unknown:
            raise ValueError(f"Unknown methods {unknown}; known are {sorted(known)}.")
        check_positive(self, "pretrain_frames", "finetune_frames", "episodes", "jobs", "log_every")


@dataclass
class Visit:
    """What was seen of one method.

    :param method: its name
    :param updates: of the pre-training
    :param reward: mean imagined intrinsic reward at each record
    :param spread: its standard deviation over imagined states
    :param loss: of a fresh module and of the trained one, on the same replayed states; empty where there is none
    :param returns: of the fine-tuned agent's evaluation episodes
    :param minutes: for everything
    """

    method: str
    updates: int = 0
    reward: list[float] = field(default_factory=list)
    spread: list[float] = field(default_factory=list)
    loss: list[float] = field(default_factory=list)
    returns: list[float] = field(default_factory=list)
    minutes: float = 0.0

    def faults(self) -> list[str]:
        """What is wrong, empty if nothing is: rewards finite and not constant, a module that learnt."""
        found = []
        if not all(map(math.isfinite, [*self.reward, *self.spread, *self.loss, *self.returns])):
            found.append("not finite")
        if self.spread and not min(self.spread) > 0:
            found.append("constant reward")
        if self.loss and not self.loss[1] < self.loss[0]:
            found.append("module did not learn")
        return found


class Records(KVWriter):
    """Keeps what a model logs."""

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []

    def write(self, key_values: dict[str, Any], key_excluded: dict[str, tuple[str, ...]], step: int = 0) -> None:
        self.rows.append(dict(key_values))

    def close(self) -> None:
        """Nothing to close."""

    def column(self, name: str) -> list[float]:
        """All values of a metric, in their order."""
        return [float(row[f"train/{name}"]) for row in self.rows if f"train/{name}" in row]


class LogEvery(BaseCallback):
    """Write a record every so many agent steps.

    :param steps: how many
    """

    def __init__(self, steps: int):
        super().__init__()
        self.steps = steps

    def _on_step(self) -> bool:
        if self.n_calls % self.steps == 0:
            self.model.dump_logs()
        return True


def visit(config: TourConfig, method: str) -> Visit:
    """Pre-train with one method, save, load the snapshot, fine-tune, evaluate.

    :param config: what to do
    :param method: name of the intrinsic reward
    """
    th.set_num_threads(1)
    began, records = time.time(), Records()
    env = gymnasium.make(f"urlb/{config.task}-v0", fast_render=True)
    model = DreamerV2("CnnPolicy", env, intrinsic_reward=method, planner="dyna_mpc", preset=config.preset, seed=config.seed)
    model.set_logger(Logger(None, [records]))
    model.learn(-(-config.pretrain_frames // model.action_repeat), LogEvery(config.log_every), log_interval=10**9)
    path = config.out / f"{method}_{config.pretrain_frames}.zip"
    model.save(path)
    seen = Visit(method, model.phase_updates)
    seen.reward, seen.spread = records.column("intrinsic_reward"), records.column("imagined_reward_std")
    seen.loss = module_losses(model)
    tuned = DreamerV2.load(path, env=env)
    tuned.fine_tune()
    tuned.learn(-(-config.finetune_frames // model.action_repeat))
    seen.returns = evaluate(tuned, env, config.episodes)
    env.close()
    seen.minutes = (time.time() - began) / 60
    return seen


@th.no_grad()
def module_losses(model: DreamerV2) -> list[float]:
    """What the method's module has learnt: the loss of a fresh one and its own, on the same replayed states.

    The loss over the run would not tell: embeddings and surprise, its targets, grow while the world model learns.

    :param model: in pre-training
    :return: two losses, or none for a method without a module
    """
    world_model, trained = model.policy.agent.world_model, model.policy.agent.intrinsic
    fresh = make_intrinsic_reward(model.intrinsic_reward, model.intrinsic_kwargs)
    assert fresh is not None and trained is not None
    fresh.build(world_model.sizes)
    batch = model.replay_buffer.sample(model.batch_size)
    posterior = world_model.observe(world_model.preprocess(batch.observation), batch.action, batch.is_first)
    learnt = [module.to(model.device).loss(posterior, batch) for module in (fresh, trained)]
    return [float(each[0]) for each in learnt if each is not None]


def run_tour(config: TourConfig) -> list[Visit]:
    """Visit every method and print the table.

    :param config: what to do
    """
    made_folder("--out", config.out)
    methods = config.methods or tuple(registered_intrinsic_rewards())
    print(_row(*COLUMNS), flush=True)
    visits = []
    for seen in _visit_all(config, methods):
        visits.append(seen)
        print(_describe(seen), flush=True)
    env = gymnasium.make(f"urlb/{config.task}-v0", fast_render=True)
    returns = evaluate(RandomPolicy(env.action_space, config.seed), env, config.episodes)
    env.close()
    print(f"Random policy: {np.mean(returns):.0f} ± {np.std(returns):.0f}. Snapshots in {config.out}/.")
    return visits


def _visit_all(config: TourConfig, methods: Sequence[str]) -> Iterator[Visit]:
    if config.jobs == 1:
        yield from (visit(config, method) for method in methods)
        return
    # Not fork: a child that inherits a renderer hangs.
    context = multiprocessing.get_context("forkserver")
    with ProcessPoolExecutor(config.jobs, mp_context=context) as pool:
        yield from pool.map(visit, [config] * len(methods), methods)


def _describe(seen: Visit) -> str:
    reward = f"{seen.reward[0]:.3g} → {seen.reward[-1]:.3g}" if seen.reward else "none"
    spread = f"{seen.spread[-1]:.2g}" if seen.reward else ""
    loss = f"{seen.loss[0]:.3g} → {seen.loss[-1]:.3g}" if seen.loss else "none"
    tuned = f"{np.mean(seen.returns):.0f} ± {np.std(seen.returns):.0f}"
    verdict = ", ".join(seen.faults()) or "ok"
    return _row(seen.method, str(seen.updates), reward, spread, loss, tuned, f"{seen.minutes:.1f}", verdict)


def _row(*cells: str) -> str:
    return "  ".join(f"{cell:<{width}}" for cell, width in zip(cells, (12, 7, 18, 8, 18, 11, 7, 0), strict=True)).rstrip()
