"""Time and memory of the particles' nearest neighbours, forward and backward: python benchmarks/particles.py.

Ours, torch.cdist + topk where that fits, and faiss where it is installed (its search alone: it knows no gradients).
Each is measured in a process of its own, so that none inherits another's memory.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import platform
import statistics
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch as th
from common import peak_rss, seconds

from sb3_dreamer_urlb.intrinsic.particles import knn_distances
from sb3_dreamer_urlb.output_reader import ending_with_its_reader

CDIST_LIMIT = 10_000  # its n × n matrices: 400 MB each here, 6.4 GB each at paper size
MB = 1e6


def parser() -> argparse.ArgumentParser:
    """Options; ``--only`` makes the process measure one thing, as the others are started."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--sizes", type=int, nargs="+", default=[2000, 5000, 10_000, 40_000], help="particles")
    options.add_argument("--dimension", type=int, default=200)
    options.add_argument("-k", type=int, default=12)
    options.add_argument("--repeat", type=int, default=3, help="timed repetitions, after one that is not (default: 3)")
    options.add_argument("--device", default="cpu")
    options.add_argument("--json", action="store_true", help="print one JSON object instead of a table")
    options.add_argument("--only", choices=METHODS, help="measure this one in this process, at the first size; prints JSON")
    return options


def reward(distances: th.Tensor) -> th.Tensor:
    """As APT's: log(1 + mean distance)."""
    return distances.mean(1).log1p().sum()


def ours(particles: th.Tensor, k: int) -> None:
    th.autograd.backward(reward(knn_distances(particles, k)))


def cdist(particles: th.Tensor, k: int) -> None:
    th.autograd.backward(reward(th.cdist(particles, particles).topk(k, largest=False).values))


def faiss(particles: th.Tensor, k: int) -> None:
    import faiss  # type: ignore[import-not-found]

    faiss.omp_set_num_threads(th.get_num_threads())
    points = particles.detach().numpy()
    index = faiss.IndexFlatL2(points.shape[1])
    index.add(points)
    index.search(points, k)


METHODS: dict[str, Callable[[th.Tensor, int], None]] = {"ours": ours, "cdist": cdist, "faiss": faiss}


def measure(options: argparse.Namespace) -> dict[str, object]:
    """Seconds of each repetition, and the bytes that the first one needed at most beyond the particles."""
    method, device = METHODS[options.only], th.device(options.device)
    th.manual_seed(0)
    method(th.randn(300, options.dimension, device=device, requires_grad=True), options.k)  # loads libraries
    particles = th.randn(options.sizes[0], options.dimension, device=device, requires_grad=True)
    before = memory(device, reset=True)
    method(particles, options.k)
    extra = memory(device) - before
    return {"seconds": seconds(lambda: method(particles, options.k), options.repeat, device), "bytes": extra}


def memory(device: th.device, reset: bool = False) -> int:
    """Peak bytes of this process, or of torch on the GPU, since the last reset."""
    if device.type == "cuda":
        if reset:
            th.cuda.reset_peak_memory_stats(device)
        return th.cuda.max_memory_allocated(device)
    if reset:
        Path("/proc/self/clear_refs").write_text("5")
    return peak_rss()


def row(size: int, options: argparse.Namespace) -> dict[str, dict[str, Any]]:
    """Every method that is installed and fits, each in a process."""
    skip = {"cdist"} if size > CDIST_LIMIT else set()
    if importlib.util.find_spec("faiss") is None or options.device != "cpu":
        skip.add("faiss")
    common = ["--sizes", size, "--dimension", options.dimension, "-k", options.k, "--device", options.device]
    result = {}
    for name in METHODS:
        if name not in skip:
            command = [sys.executable, __file__, *common, "--repeat", options.repeat, "--only", name]
            run = subprocess.run([str(word) for word in command], check=True, stdout=subprocess.PIPE, text=True)
            result[name] = json.loads(run.stdout)
    return result


def absolute(methods: dict[str, dict[str, Any]], name: str) -> str:
    """Median seconds and megabytes."""
    if name not in methods:
        return "-"
    return f"{statistics.median(methods[name]['seconds']):.3f} ({methods[name]['bytes'] / MB:.0f})"


def ratio(methods: dict[str, dict[str, Any]], name: str) -> str:
    """How many times our seconds and our memory ``name`` takes."""
    if name not in methods:
        return "-"
    theirs, mine = methods[name], methods["ours"]
    time = statistics.median(theirs["seconds"]) / statistics.median(mine["seconds"])
    return f"{time:.2f} ({theirs['bytes'] / mine['bytes']:.2f})"


@ending_with_its_reader()
def main() -> None:
    """Print the table: first what the others take as a multiple of ours, then seconds and megabytes."""
    options = parser().parse_args()
    if options.only:
        print(json.dumps(measure(options)))
        return
    rows = {size: row(size, options) for size in options.sizes}
    device = th.device(options.device)
    machine = {
        "device": th.cuda.get_device_name(device) if device.type == "cuda" else platform.processor() or platform.machine(),
        "threads": th.get_num_threads(),
        "torch": th.__version__,
        "dimension": options.dimension,
        "k": options.k,
    }
    if options.json:
        print(json.dumps({"benchmark": "particles", **machine, "sizes": rows}))
        return
    print(f"particles: {', '.join(f'{key} {value}' for key, value in machine.items())}")
    titles = ("cdist / ours", "faiss / ours", "ours", "cdist + topk", "faiss search")
    print("  particles" + "".join(f"  {title:>15}" for title in titles) + "   time (memory): ratios, then seconds (MB)")
    for size, methods in rows.items():
        cells = [ratio(methods, name) for name in ("cdist", "faiss")] + [absolute(methods, name) for name in METHODS]
        print(f"  {size:>9}" + "".join(f"  {cell:>15}" for cell in cells))


if __name__ == "__main__":
    main()
