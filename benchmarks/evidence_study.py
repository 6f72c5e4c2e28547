"""Which runs answer whether pre-training pays, at which size, and where their results lie (``evidence.py`` does them)."""

from __future__ import annotations

import csv
import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from sb3_dreamer_urlb.nn.precision import cpu_is_fast_at_short

ROOT = Path(__file__).parents[1] / "results" / "evidence"
#: body → the environment of its pre-training, whose reward nobody sees
PRIMAL = {"walker": "stand", "finger": "spin"}
#: task → body, where it is not the walker. Spin pays 1 while the finger spins fast, else 0: random actions get 2 of 1000
BODIES = {"spin": "finger"}
#: agent steps; an episode has 500
REPEAT, EPISODE = 2, 500


@dataclass(frozen=True)
class Arm:
    """How agents come to a task.

    :param method: intrinsic reward of the pre-training; None: from scratch
    :param keeps_actor: into the fine-tuning
    :param changes: arguments that the fine-tuning has otherwise than the pre-training
    """

    method: str | None
    keeps_actor: bool = False
    changes: dict[str, Any] = field(default_factory=dict)


ARMS = {
    "scratch": Arm(None),
    "lbs-kept": Arm("lbs", True),
    "lbs-fresh": Arm("lbs"),
    "random-fresh": Arm("random"),
    "plan2explore-kept": Arm("plan2explore", True),
    "plan2explore-fresh": Arm("plan2explore"),
    # What else may help or hide it: how soon the new critic's target follows; how fast the model is retrained, on how much.
    "lbs-kept-target-2": Arm("lbs", True, {"target_update_interval": 2}),
    "lbs-kept-target-50": Arm("lbs", True, {"target_update_interval": 50}),
    "lbs-kept-rate-2e-4": Arm("lbs", True, {"learning_rate": 2e-4}),
    "lbs-kept-start-2500": Arm("lbs", True, {"learning_starts": 2500}),
}


@dataclass(frozen=True)
class Setting:
    """How large a run is, and what its agent sees.

    :param policy: of the constructor
    :param observation: of the environment; states go through ``VecNormalize``, pictures do not
    :param preset: of the agent
    :param pretraining: agent steps
    :param finetuning: agent steps
    :param device: of the agent
    :param further: arguments of the constructor, before the preset's
    """

    policy: str
    observation: str
    preset: str
    pretraining: int
    finetuning: int
    device: str = "cpu"
    further: dict[str, Any] = field(default_factory=dict)

    @property
    def normalized(self) -> bool:
        """Whether ``VecNormalize`` stands between environment and agent."""
        return self.observation == "state"


SETTINGS = {
    "state": Setting("MlpPolicy", "state", "state-small", 20_000, 10_000),
    # Updates as rare as the paper's, every ten frames, and in the paper size's format where the processor has it: with the
    # preset's own, runs would take two and a half times as long.
    "pixels": Setting(
        "CnnPolicy",
        "pixels",
        "small",
        50_000,
        10_000,
        further={"train_freq": 5, "precision": "bfloat16" if cpu_is_fast_at_short() else "float32"},
    ),
    # 100k frames each, at the paper's size: for a GPU.
    "paper": Setting("CnnPolicy", "pixels", "paper", 50_000, 50_000, "auto"),
}
Tier = tuple[tuple[str, ...], tuple[str, ...], int]
#: setting → what to run, most telling first: arms, tasks, number of seeds
STUDY: dict[str, tuple[Tier, ...]] = {
    "state": (
        (("lbs-kept", "scratch"), ("run", "flip"), 5),
        (("lbs-kept", "scratch"), ("spin",), 3),
        (("lbs-kept", "scratch"), ("run", "flip"), 10),
        (("random-fresh", "lbs-fresh"), ("run", "flip"), 3),
        (("plan2explore-kept",), ("run", "flip"), 3),
        # Their pre-training is done: does the model alone carry it, or the actor, too?
        (("lbs-fresh",), ("run", "flip"), 10),
        (tuple(arm for arm in ARMS if ARMS[arm].changes), ("flip",), 3),
        (("lbs-kept", "scratch"), ("spin",), 10),
        (("random-fresh", "lbs-fresh", "plan2explore-kept", "plan2explore-fresh"), ("run", "flip", "spin"), 10),
    ),
    "pixels": (
        (("lbs-kept", "scratch"), ("run", "flip"), 5),
        (("random-fresh",), ("run", "flip"), 5),
    ),
    "paper": ((("lbs-kept", "scratch"), ("stand", "run"), 3),),
}


@dataclass(frozen=True)
class Run:
    """
    :param arm: of ``ARMS``, or the method of a pre-training
    :param task: of the body; ``""`` for the pre-training itself
    :param seed: of everything
    :param body: of ``PRIMAL``
    :param size: of ``SETTINGS``
    """

    arm: str
    task: str
    seed: int
    body: str = "walker"
    size: str = "state"

    @property
    def setting(self) -> Setting:
        """What ``size`` means."""
        return SETTINGS[self.size]

    @property
    def name(self) -> str:
        """Of its folder, and in ``episodes.csv``."""
        body = "" if self.body == "walker" else f"-{self.body}"
        return f"{prefix(self.size)}{self.task or f'pretraining{body}'}/{self.arm}/{self.seed}"

    @property
    def steps(self) -> int:
        """Agent steps."""
        return self.setting.finetuning if self.task else self.setting.pretraining

    @property
    def needs(self) -> Run | None:
        """The pre-training that it starts from."""
        method = ARMS[self.arm].method if self.task else None
        return Run(method, "", self.seed, self.body, self.size) if method is not None else None


def prefix(size: str) -> str:
    """Of the names of a setting's runs."""
    return "" if size == "state" else f"{size}-"


def wanted(size: str = "state") -> Iterator[Run]:
    """All runs of a setting in order, each after the pre-training that it needs."""
    seen = set()
    for arms, tasks, seeds in STUDY[size]:
        for seed, task, arm in itertools.product(range(seeds), tasks, arms):
            run = Run(arm, task, seed, BODIES.get(task, "walker"), size)
            for one in (run.needs, run):
                if one is not None and one not in seen:
                    seen.add(one)
                    yield one


def snapshot_of(pretraining: Run) -> Path:
    """Where a pre-trained agent lies; the statistics of its observations, if it has any, lie beside it."""
    body = "" if pretraining.body == "walker" else f"{pretraining.body}-"
    return ROOT / "snapshots" / f"{prefix(pretraining.size)}{body}{pretraining.arm}-{pretraining.seed}.zip"


def curves() -> dict[str, list[tuple[int, float]]]:
    """Agent step and return of the episodes of the finished runs, by name."""
    found: dict[str, list[tuple[int, float]]] = {}
    path = ROOT / "episodes.csv"
    if path.exists():
        with open(path, newline="") as file:
            for row in csv.DictReader(file):
                found.setdefault(row["run"], []).append((int(row["step"]), float(row["return"])))
    return found
