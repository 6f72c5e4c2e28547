"""Every combination of precision, compile, planner and spaces once, tiny: a program, for it runs as another processor would.

What the processor has is decided when a process begins: environment variables hide parts of it (``MASKED``).
"""

from __future__ import annotations

import itertools
import json
import sys
import traceback
import warnings
from typing import Any

import numpy as np
import torch as th
from fake_envs import CounterEnv
from gymnasium import spaces
from told import told_meanwhile

from sb3_dreamer_urlb import DreamerV2, native
from sb3_dreamer_urlb.learning.graphs import COMPILE
from sb3_dreamer_urlb.native import planner_ops, product_ops
from sb3_dreamer_urlb.nn import activation, distributions, precision
from sb3_dreamer_urlb.world_model import convolution, gru

#: environment variables that make of an x86 processor one with AVX2 and nothing newer: for oneDNN, torch, and our own kernels
MASKED = {
    "ONEDNN_MAX_CPU_ISA": "AVX2",
    "ATEN_CPU_CAPABILITY": "avx2",
    "MKL_ENABLE_INSTRUCTIONS": "AVX2",
    "SB3_DREAMER_URLB_MARCH": "x86-64-v3",
}
NUMBERS = spaces.Box(-1, 1, (5,), np.float32)
SPACES = {
    "images and numbers": ("CnnPolicy", None, None),
    "vectors and choices": ("MlpPolicy", NUMBERS, spaces.Discrete(3)),
    "both and tables": (
        "MultiInputPolicy",
        spaces.Dict({"camera": spaces.Box(0, 255, (16, 16, 3), np.uint8), "joints": NUMBERS}),
        spaces.MultiDiscrete([2, 3]),
    ),
}
PLANNERS = (None, "dyna_mpc")


def main() -> None:
    """Print what the processor was taken to have, which combinations failed, and what was warned of."""
    warnings.simplefilter("always")
    th.set_num_threads(1)
    found: dict[str, Any] = {"torch": th.backends.cpu.get_cpu_capability(), "short": precision.cpu_multiplies_short()}
    with native.using("auto", "cpu"):
        found |= {"native": native.active(), "lanes": native.on_lanes(), "tiles": native.active() and product_ops.available()}
    faults, warned = [], []
    combinations = [(*its, False) for its in itertools.product(precision.PRECISIONS, COMPILE, PLANNERS, SPACES)]
    combinations += [(*its, True) for its in itertools.product(precision.PRECISIONS, ["native"], PLANNERS, SPACES)]
    for combination in combinations:
        with told_meanwhile() as said:
            try:
                run(*combination)
            except Exception:
                faults.append(f"{combination}: {traceback.format_exc(limit=-4)}")
        warned += [f"{combination}: {one}" for one in said]
    print(json.dumps({**found, "faults": faults, "warnings": warned}))


def run(its_precision: str, compile: str, planner: str | None, which: str, every_size: bool) -> None:
    """Learn, plan, and see that all numbers are finite.

    :param every_size: whether kernels of our own compute tiny tensors, too
    """
    policy, observations, actions = SPACES[which]
    env = CounterEnv(6, observation_space=observations, action_space=actions)
    with sizes(every_size):
        model = DreamerV2(
            policy, env, preset="tiny", seed=0, device="cpu", precision=its_precision, compile=compile, planner=planner
        ).learn(20)
    assert model.phase_updates > 0
    assert all(th.isfinite(value).all() for value in model.policy.state_dict().values())


class sizes:
    """Inside, tensors of every size are worth a kernel of our own, if ``every``."""

    def __init__(self, every: bool):
        self.changes: list[tuple[Any, str, Any]] = []
        if every:
            gradient = {th.float32: 0, th.bfloat16: 0}
            self.changes = [
                (activation, "SMALLEST_NATIVE", 0),
                (activation, "SMALLEST_NATIVE_LEARNING", 0),
                (activation, "SMALLEST_NATIVE_GRADIENT", gradient),
                (distributions, "NATIVE_SIZE", 0),
                (product_ops, "ROWS", 1),
                (product_ops, "COLUMNS", 1),
                (convolution, "CHANNELS", 1),
                (gru, "NATIVE_ROWS", 1),
                (planner_ops, "fast", lambda: True),
            ]

    def __enter__(self) -> None:
        self.before = [(module, name, getattr(module, name)) for module, name, _ in self.changes]
        for change in self.changes:
            setattr(*change)

    def __exit__(self, *_: object) -> None:
        for change in self.before:
            setattr(*change)


if __name__ == "__main__":
    main()
    sys.stdout.flush()
