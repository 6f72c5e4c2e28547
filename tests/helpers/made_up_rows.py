"""Rows that nobody measured, for tests and for pictures that say so: every row has ``synthetic=true``."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from sb3_dreamer_urlb.evaluation.names import TASKS
from sb3_dreamer_urlb.evaluation.rows import Row
from sb3_dreamer_urlb.evaluation.scores import ORACLE
from sb3_dreamer_urlb.transfer_rule import keeps_actor

SEEDS, PRETRAIN, FINETUNE = 3, 2_000_000, 100_000
SHARE = {"lbs": 0.93, "plan2explore": 0.88, "icm": 0.85, "rnd": 0.84, "apt": 0.86, "diayn": 0.7, "aps": 0.72, "random": 0.6}


def made_up_rows(seeds: int = SEEDS, methods: tuple[str, ...] = tuple(SHARE)) -> list[Row]:
    """A study of everything that the figures show.

    :param seeds: of every run
    :param methods: of exploration
    """
    generator = np.random.default_rng(0)

    def row(method: str, task: str, seed: int, share: float, **changes: Any) -> Row:
        domain, name = task.split("-")
        value = float(max(0.0, ORACLE[task] * (share + generator.normal(0, 0.04))))
        columns = {
            "pretrain_frames": PRETRAIN, "finetune_frames": FINETUNE, "keep_actor": keeps_actor(domain), "keep_critic": False,
            "planner": "none", "preset": "paper", **changes,
        }  # fmt: skip
        own = {key: columns.pop(key) for key in list(columns) if key not in Row.__dataclass_fields__}
        further = {"synthetic": "true", **{key: str(value).lower() for key, value in own.items()}}
        return Row(
            method,
            domain,
            name,
            seed,
            return_mean=value,
            return_std=20.0,
            episodes=10,
            seconds=60.0,
            further=further,
            **columns,
        )

    def everything() -> Iterator[Row]:
        for seed in range(seeds):
            for task in TASKS:
                yield from _benchmark(row, methods, task, seed)
                yield from _analyses(row, methods, task, seed, generator)
            yield from _changed(row, seed)

    return list(everything())


def _benchmark(row: Any, methods: tuple[str, ...], task: str, seed: int) -> Iterator[Row]:
    scratch = {"pretrain_frames": 0, "keep_actor": None, "keep_critic": None}
    for frames in range(10_000, FINETUNE + 1, 10_000):
        yield row("dreamer", task, seed, 0.28 * frames / FINETUNE, **scratch, finetune_frames=frames)
    yield row("drqv2", task, seed, 0.18, **scratch)
    yield row("disagreement", task, seed, 0.39, keep_actor=True)
    for method in methods:
        share = SHARE[method]
        for pretrain in (100_000, 500_000, 1_000_000, 2_000_000, 3_000_000, 5_000_000):
            grown = share * (0.6 + 0.4 * min(1.0, pretrain / PRETRAIN))
            seen = {"intrinsic_reward": round(1.5 - grown + 0.02 * len(task), 3)} if pretrain == PRETRAIN else {}
            if pretrain <= PRETRAIN:
                yield row(method, task, seed, grown - 0.06, pretrain_frames=pretrain, **seen)
            if pretrain >= 1_000_000 and pretrain != PRETRAIN:
                yield row(method, task, seed, grown, planner="dyna_mpc", pretrain_frames=pretrain)
        yield row(method, task, seed, share, planner="dyna_mpc")
        for frames in range(10_000, FINETUNE, 10_000):
            yield row(method, task, seed, (share - 0.06) * (0.4 + 0.6 * frames / FINETUNE), finetune_frames=frames)
        other = not keeps_actor(task.split("-")[0])
        yield row(method, task, seed, share - 0.2, keep_actor=other)
        yield row(method, task, seed, share - 0.35, keep_actor=True, keep_critic=True)


def _analyses(row: Any, methods: tuple[str, ...], task: str, seed: int, generator: Any) -> Iterator[Row]:
    if "plan2explore" in methods:
        hard = float(generator.uniform(0.1, 1.0))
        yield row("plan2explore", task, seed, 0.4 - 0.2 * hard, planner="mppi", finetune_frames=0)
        yield row("plan2explore", task, seed, 0.5, planner="mppi", ldd=round(0.6 * hard, 3))
        yield row("plan2explore", task, seed, 0.9, known_reward=True)


def _changed(row: Any, seed: int) -> Iterator[Row]:
    scratch = {"pretrain_frames": 0, "keep_actor": None, "keep_critic": None}
    for task in ("walker-walk", "quadruped-walk"):
        for level, loss in (("easy", 0.1), ("medium", 0.35), ("hard", 0.8)):
            yield row("lbs", task, seed, 0.95 - loss, planner="dyna_mpc", perturbation=level)
            # A gap: nobody ran random actions where it is hard.
            if level != "hard":
                yield row("random", task, seed, 0.7 - loss, planner="dyna_mpc", perturbation=level)
            for frames, share in ((FINETUNE, 0.3), (1_000_000, 0.8), (2_000_000, 0.95)):
                yield row("dreamer", task, seed, max(0.0, share - loss), **scratch, finetune_frames=frames, perturbation=level)
    for task in (task for task in TASKS if task.startswith("jaco")):
        for variant, loss in (("sparse", 0.4), ("dense", 0.05)):
            yield row("lbs", task, seed, 0.9 - loss, variant=variant)
            yield row("lbs", task, seed, 0.9 - 1.8 * loss, variant=variant, keep_actor=True)
