"""What the benchmarks share: options, a model without an environment, timing, floors, a report."""

from __future__ import annotations

import argparse
import json
import math
import os
import platform
import re
import statistics
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any
from unittest import mock

import gymnasium
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.utils import get_device
from torch.utils.flop_counter import FlopCounterMode

from sb3_dreamer_urlb import DreamerV2, native
from sb3_dreamer_urlb.algorithm.advice import NoUpdateWarning
from sb3_dreamer_urlb.nn.precision import cpu_multiplies_short


class NoiseImages(gymnasium.Env[np.ndarray, np.ndarray]):
    """Walker-sized images of noise: what is timed does not depend on their content.

    :param size: height and width
    """

    action_space = spaces.Box(-1, 1, (6,), np.float32)
    never_terminates = True

    def __init__(self, size: int = 64) -> None:
        self.observation_space = spaces.Box(0, 255, (size, size, 3), np.uint8)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.steps = 0
        return self._image(), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        return self._image(), 0.5, False, self.steps == 100, {}

    def _image(self) -> np.ndarray:
        return self.np_random.integers(0, 256, self.observation_space.shape, np.uint8)


def parser(description: str | None) -> argparse.ArgumentParser:
    """Options that every benchmark takes."""
    options = argparse.ArgumentParser(description=description)
    options.add_argument("--preset", default="paper", help="size of the model (default: paper)")
    formats = ["float32", *(["bfloat16"] if multiplies_well(th.bfloat16, get_device("auto")) else [])]
    options.add_argument(
        "--precision", nargs="+", default=formats, help="formats of products to compare (default here: %(default)s)"
    )
    options.add_argument(
        "--compile", nargs="+", default=["auto"], help="whose kernels, to compare: auto, native, eager (default: auto)"
    )
    options.add_argument(
        "--repeat", type=int, default=3, help="timed repetitions, after one that is not (default: %(default)s)"
    )
    options.add_argument("--threads", type=int, help="of torch (default: as many as torch takes)")
    options.add_argument(
        "--clock",
        choices=CLOCKS,
        default="wall",
        help="cpu counts this process's CPU time: for one thread on a machine that others use, too",
    )
    options.add_argument("--device", default="auto")
    options.add_argument(
        "--json",
        nargs="?",
        const=STDOUT,
        metavar="FILE",
        help="write a JSON object there, too; without FILE print it instead",
    )
    options.add_argument("--quick", action=Quick, help="smallest networks, once: whether it runs, not how fast")
    return options


#: of ``--json``
STDOUT = "-"


class Quick(argparse.Action):
    """``--quick``: what makes every benchmark a matter of seconds; options after it win."""

    def __init__(self, option_strings: Sequence[str], dest: str, **kwargs: Any):
        super().__init__(option_strings, dest, nargs=0, default=False, **kwargs)

    def __call__(self, parser: argparse.ArgumentParser, namespace: argparse.Namespace, *_: object) -> None:
        namespace.quick, namespace.preset, namespace.repeat = True, "tiny", 1
        Product.resize(64)


CLOCKS = {"wall": time.perf_counter, "cpu": time.process_time}


def make_model(options: argparse.Namespace, **kwargs: Any) -> DreamerV2:
    """A fresh model on noise images."""
    set_threads(options)
    kwargs.setdefault("compile", options.compile[0])
    return DreamerV2("CnnPolicy", NoiseImages(), preset=options.preset, device=options.device, seed=0, **kwargs)


def fill_replay(model: Any, steps: int = 0) -> None:
    """Episodes to draw from, and no update yet.

    :param model: whose ``learning_starts`` is larger
    :param steps: of the agent; 0 for two episodes that hold a sequence each
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NoUpdateWarning)
        model.learn(steps or max(2 * model.batch_length, 200))


def set_threads(options: argparse.Namespace) -> None:
    """As many as ``--threads`` asks for, if it does."""
    if getattr(options, "threads", None):
        th.set_num_threads(options.threads)


def seconds(work: Callable[[], object], repeat: int, device: th.device, clock: str = "wall", warm_up: int = 1) -> list[float]:
    """Time of each repetition; the warming up does not count."""
    times = []
    for _ in range(repeat + warm_up):
        begin = CLOCKS[clock]()
        work()
        if device.type == "cuda":
            th.cuda.synchronize(device)
        times.append(CLOCKS[clock]() - begin)
    return times[warm_up:]


def interleaved(
    work: dict[str, Callable[[], object]], options: argparse.Namespace, device: th.device
) -> dict[str, list[float]]:
    """Times of each entry; they take turns, so that what else the machine does meets all of them."""
    rows: dict[str, list[float]] = {name: [] for name in work}
    for turn in range(options.repeat + 1):
        for name, part in work.items():
            times = seconds(part, 1, device, options.clock, warm_up=0)
            rows[name] += times if turn else []
    return rows


def tflop(work: Callable[[], object]) -> float:
    """TFLOP of matrix products and convolutions that some work asks for, as torch counts them.

    The work is done with torch's kernels, because it knows nothing of ours.
    """
    prepacked = getattr(th.ops.mkldnn, "_linear_pointwise", None)
    counter = FlopCounterMode(display=False, custom_mapping={prepacked: _prepacked} if prepacked else {})
    with mock.patch.object(native, "active", lambda: False), counter:
        work()
    return float(counter.get_total_flops()) / 1e12


def _prepacked(x: Sequence[int], *_: Any, out_shape: Sequence[int], **__: Any) -> int:
    """Of the product that PrepackedLinear asks for, which torch does not count."""
    return 2 * math.prod(x) * out_shape[-1]


def multiplies_well(dtype: th.dtype, device: th.device) -> bool:
    """Whether a device has instructions for products of a format; without, they take hundreds of times what float32's take.

    It is asked, not timed: on a busy machine two threads may take longer over a small float32 product.
    """
    if dtype == th.float32:
        return True
    has_bfloat16 = cpu_multiplies_short() if device.type == "cpu" else th.cuda.is_bf16_supported(including_emulation=False)
    return dtype == th.bfloat16 and has_bfloat16


class Product:
    """A big matrix product, 4096³ unless ``--quick``: the arithmetic that a machine can do at best.

    :param dtype: wanted format; where the machine does not multiply it well, the product is float32's, see ``name``
    :param device: where
    """

    SIZE = 4096
    TFLOP = 2 * SIZE**3 / 1e12

    @classmethod
    def resize(cls, size: int) -> None:
        """Let all that follow have so many rows and columns."""
        cls.SIZE, cls.TFLOP = size, 2 * size**3 / 1e12

    def __init__(self, dtype: th.dtype, device: th.device):
        dtype = dtype if multiplies_well(dtype, device) else th.float32
        #: of its row in a table
        self.name = f"product of {self.SIZE}³ in {str(dtype).removeprefix('torch.')}"
        self.left, self.right = (th.randn(self.SIZE, self.SIZE, device=device).to(dtype) for _ in range(2))

    def __call__(self) -> th.Tensor:
        return self.left @ self.right


@dataclass(frozen=True)
class Floor:
    """What a row is compared with.

    :param row: its name
    :param factor: that many times it
    :param target: the ratio to stay below
    """

    row: str
    factor: float
    target: float | None = None


def peak_rss() -> int:
    """Bytes of memory that this process had at most. Linux: not ``resource.getrusage``, which begins with the parent's."""
    found = re.search(r"VmHWM:\s+(\d+) kB", Path("/proc/self/status").read_text())
    assert found is not None
    return int(found[1]) * 1024


def machine(options: argparse.Namespace, device: th.device) -> dict[str, object]:
    """Where and how something was timed."""
    return {
        "device": th.cuda.get_device_name(device) if device.type == "cuda" else _cpu_name(),
        "cores": os.cpu_count(),
        "load": round(os.getloadavg()[0], 1),
        "threads": th.get_num_threads(),
        "clock": options.clock,
        "kernels": " and ".join(native.describe(compile, device) for compile in getattr(options, "compile", ["auto"])),
        "python": platform.python_version(),
        **{package: found for package in PACKAGES if (found := _version(package))},
        **({"preset": options.preset} if options.preset else {}),
    }


#: whose versions matter for speed
PACKAGES = ("torch", "numpy", "stable-baselines3", "mujoco", "dm-control", "sb3_dreamer_urlb")


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _cpu_name() -> str:
    """With the units that decide how fast bfloat16 is; Linux only, elsewhere what Python knows."""
    try:
        info = Path("/proc/cpuinfo").read_text()
    except OSError:
        return platform.processor() or platform.machine()
    fields = dict(line.split(":", 1) for line in info.splitlines() if ":" in line)
    found = {name.strip(): value.strip() for name, value in fields.items()}
    units = [unit for unit in ("avx512_bf16", "amx_bf16") if unit in found.get("flags", "").split()]
    return " ".join([found.get("model name", platform.machine()), *units])


def report(
    name: str,
    rows: dict[str, list[float]],
    floors: dict[str, Floor],
    options: argparse.Namespace,
    device: th.device,
    amounts: dict[str, dict[str, float]] | None = None,
    notes: Sequence[str] = (),
    **more: object,
) -> None:
    """Print the table, ratios first, and write the JSON object, or print that. A ratio is best time over best time.

    :param name: of the benchmark
    :param rows: times of everything measured, the floors' rows included
    :param floors: what rows are compared with
    :param options: of the command line
    :param device: that was measured
    :param amounts: row → unit → how much of it one time stands for: printed as a rate
    :param notes: lines below the table
    :param more: for the JSON object only
    """
    about = machine(options, device)
    ratios = {row: min(rows[row]) / (floor.factor * min(rows[floor.row])) for row, floor in floors.items() if row in rows}
    rates = {
        row: {f"{unit}/s": amount / min(rows[row]) for unit, amount in units.items()}
        for row, units in (amounts or {}).items()
        if row in rows
    }
    if write_json(
        {"benchmark": name, **about, "ratios": ratios, "rates": rates, "seconds": rows, "notes": list(notes), **more}, options
    ):
        return
    print(f"{name}: {', '.join(f'{key} {value}' for key, value in about.items())}")
    width = max(map(len, rows))
    for row in [*ratios, *(row for row in rows if row not in ratios)]:
        ratio, compared = "", ""
        if row in ratios:
            ratio, floor = f"{ratios[row]:.2f} ×", floors[row]
            target = "" if floor.target is None else f", target {floor.target:g}"
            compared = f"  ({floor.factor:.4g} × {floor.row}{target})"
        rate = "".join(f"  {value:.4g} {unit}" for unit, value in rates.get(row, {}).items())
        times = rows[row]
        print(f"  {ratio:>8}  {row:<{width}}  {min(times):8.4g} s, median {statistics.median(times):.4g}{rate}{compared}")
    for note in notes:
        print(f"  {note}")


def write_json(result: dict[str, Any], options: argparse.Namespace) -> bool:
    """To the file that ``--json`` names.

    :param result: what was measured
    :param options: of the command line
    :return: whether it was printed, in place of the table
    """
    if options.json == STDOUT:
        print(json.dumps(result))
    elif options.json:
        Path(options.json).write_text(json.dumps(result, indent=1) + "\n")
    return bool(options.json == STDOUT)
