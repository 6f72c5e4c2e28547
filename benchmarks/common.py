"""What the benchmarks share: options, a model without an environment, timing, a report."""

from __future__ import annotations

import argparse
import json
import platform
import statistics
import time
from collections.abc import Callable

import gymnasium
import numpy as np
import torch as th
from gymnasium import spaces

from sb3_dreamer_urlb import DreamerV2


class NoiseImages(gymnasium.Env):
    """Walker-sized images of noise: what is timed does not depend on their content."""

    observation_space = spaces.Box(0, 255, (64, 64, 3), np.uint8)
    action_space = spaces.Box(-1, 1, (6,), np.float32)
    never_terminates = True

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.steps = 0
        return self._image(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        self.steps += 1
        return self._image(), 0.5, False, self.steps == 100, {}

    def _image(self) -> np.ndarray:
        return self.np_random.integers(0, 256, (64, 64, 3), np.uint8)


def parser(description: str | None) -> argparse.ArgumentParser:
    """Options that every benchmark takes."""
    options = argparse.ArgumentParser(description=description)
    options.add_argument("--preset", default="paper", help="size of the model (default: paper)")
    options.add_argument("--repeat", type=int, default=3, help="timed repetitions, after one that is not (default: 3)")
    options.add_argument("--device", default="auto")
    options.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    return options


def make_model(options: argparse.Namespace, **kwargs: object) -> DreamerV2:
    """A fresh model on noise images."""
    return DreamerV2("CnnPolicy", NoiseImages(), preset=options.preset, device=options.device, seed=0, **kwargs)


def seconds(work: Callable[[], object], repeat: int, device: th.device) -> list[float]:
    """Wall time of each repetition; the first run warms up and does not count."""
    times = []
    for _ in range(repeat + 1):
        begin = time.perf_counter()
        work()
        if device.type == "cuda":
            th.cuda.synchronize(device)
        times.append(time.perf_counter() - begin)
    return times[1:]


def report(name: str, rows: dict[str, list[float]], options: argparse.Namespace, device: th.device) -> None:
    """Print the table, or the JSON object."""
    machine = {
        "device": th.cuda.get_device_name(device) if device.type == "cuda" else platform.processor() or platform.machine(),
        "threads": th.get_num_threads(),
        "torch": th.__version__,
        "preset": options.preset,
    }
    if options.json:
        print(json.dumps({"benchmark": name, **machine, "seconds": rows}))
        return
    print(f"{name}: {', '.join(f'{key} {value}' for key, value in machine.items())}")
    width = max(map(len, rows))
    for row, times in rows.items():
        print(f"  {row:<{width}}  {statistics.median(times):8.4f} s  (best {min(times):.4f} of {len(times)})")
