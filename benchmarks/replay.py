"""Rates of the replay's stores against plain numpy: python benchmarks/replay.py, batches of 50×50 frames of 64×64×3.

The floor of sample gathers the same bytes from flat arrays by one fancy index a column; that of add copies the same
rows into flat arrays, one by one as they come. Stores are measured full, so that every new episode drives an old one out.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from common import Floor, NoiseImages, interleaved, parser, report, set_threads
from gymnasium import spaces
from stable_baselines3.common.utils import get_device

from sb3_dreamer_urlb import SequenceReplayBuffer
from sb3_dreamer_urlb.learning.memory import keep_freed_memory
from sb3_dreamer_urlb.output_reader import ending_with_its_reader
from sb3_dreamer_urlb.replay.stores import STORES

#: that keep their rows in a folder
ON_DISK = ("lmdb",)
EPISODE = 500  # agent steps of a walker or quadruped episode
MB = 1e6
GATHER, COPY = "numpy, gathered", "numpy, copied"


class Flat:
    """What any replay must do at least: rows in one array a column.

    :param columns: name → type and shape of a row
    :param rows: how many
    :param device: where batches go
    """

    def __init__(self, columns: dict[str, tuple[th.dtype, tuple[int, ...]]], rows: int, device: th.device):
        self.columns = {
            # Written to: pages that were never touched would all be the same one.
            name: np.full((rows, *shape), 1, th.empty(0, dtype=dtype).numpy().dtype)
            for name, (dtype, shape) in columns.items()
        }
        self.rows, self.device = rows, device
        self.rng = np.random.default_rng(0)
        self.next = 0

    def sample(self, batch_size: int, length: int) -> list[th.Tensor]:
        """Random sequences, (B, T, …)."""
        index = self.rng.integers(self.rows - length + 1, size=(batch_size, 1)) + np.arange(length)
        return [th.from_numpy(rows[index]).to(self.device, non_blocking=True) for rows in self.columns.values()]

    def add(self, episode: list[dict[str, Any]]) -> None:
        """Copy rows in, over the oldest."""
        for row in episode:
            for name, value in row.items():
                self.columns[name][self.next] = value
            self.next = (self.next + 1) % self.rows


def make_episode(steps: int) -> list[tuple[Any, ...]]:
    """Arguments of each ``add`` of one environment's episode of noise."""
    env, rng = NoiseImages(), np.random.default_rng(0)
    images = rng.integers(0, 256, (steps + 1, 1, 3, 64, 64), np.uint8)
    actions = rng.uniform(-1, 1, (steps, 1, *env.action_space.shape)).astype(np.float32)
    dones = np.arange(1, steps + 1).reshape(steps, 1) == steps
    infos = [{"TimeLimit.truncated": True}]
    return [(images[t], images[t + 1], actions[t], np.ones(1, np.float32), dones[t], infos) for t in range(steps)]


def make_buffer(store: str, options: argparse.Namespace, device: th.device, folder: Path) -> SequenceReplayBuffer:
    """An empty buffer with this store."""
    kwargs: dict[str, Any] = {"path": folder / store} if store in ON_DISK else {}
    return SequenceReplayBuffer(
        options.rows,
        spaces.Box(0, 255, (3, 64, 64), np.uint8),
        NoiseImages.action_space,
        device,
        batch_length=options.length,
        seed=0,
        store=store,
        **kwargs,
    )


def fill(buffer: SequenceReplayBuffer, episode: list[tuple[Any, ...]]) -> Callable[[], None]:
    """Fill a buffer.

    :return: adds one more episode
    """

    def add() -> None:
        for step in episode:
            buffer.add(*step)

    for _ in range(-(-buffer.buffer_size // len(episode))):
        add()
    return add


@ending_with_its_reader()
def main() -> None:
    """Time adding an episode to each store, and drawing a batch from it."""
    choice = parser(__doc__)
    choice.add_argument("--stores", nargs="+", default=[store for store in STORES if store != "auto"], choices=STORES)
    choice.add_argument("--rows", type=int, default=20_000, help="that a store holds (default: 20 000, 246 MB)")
    choice.add_argument("--batch", type=int, default=50, help="sequences a batch (default: 50)")
    choice.add_argument("--length", type=int, default=50, help="rows a sequence (default: 50)")
    choice.set_defaults(repeat=10)
    options = choice.parse_args()
    set_threads(options)
    if options.quick:
        options.rows, options.batch, options.length = 300, 4, 10
    device = get_device(options.device)
    if device.type == "cpu":
        keep_freed_memory()  # as a learner does
    episode = make_episode(min(EPISODE, options.rows // 3))
    work: dict[str, Callable[[], object]] = {}
    floors, missing = {}, []
    with tempfile.TemporaryDirectory() as folder:
        for store in options.stores:
            try:
                buffer = make_buffer(store, options, device, Path(folder))
            except (ValueError, RuntimeError, ModuleNotFoundError) as error:
                missing.append(f"{store} does not work here: {error}")
                continue
            work[f"sample, {store}"] = partial(buffer.sample, options.batch)
            work[f"add, {store}"] = fill(buffer, episode)
            floors[f"sample, {store}"], floors[f"add, {store}"] = Floor(GATHER, 1), Floor(COPY, 1)
        flat = Flat(buffer.columns(), options.rows, device)
        rows = [{"observation": step[1][0], "action": step[2][0], "reward": 1.0, "is_terminal": False} for step in episode]
        work[GATHER] = lambda: flat.sample(options.batch, options.length)
        work[COPY] = lambda: flat.add([{"observation": episode[0][0][0]}, *rows])
        times = interleaved(work, options, device)
    drawn, added, size = options.batch * options.length, len(episode) + 1, buffer.row_bytes()
    amounts = {
        row: {"rows": drawn, "batches": 1, "MB": drawn * size / MB}
        if row.startswith(("sample", GATHER))
        else {"rows": added, "MB": added * size / MB}
        for row in work
    }
    report("replay", times, floors, options, device, amounts, missing, held=options.rows, row_bytes=size)


if __name__ == "__main__":
    main()
