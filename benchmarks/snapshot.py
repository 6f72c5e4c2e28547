"""Seconds to save and to load a snapshot: python benchmarks/snapshot.py, all optimisers' moments included.

The floors write the same bytes to the same disk, fsync included, and read them back. Promised for the paper's sizes: under
3 s each (docs/reliability.md).
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import torch as th
from common import Floor, NoiseImages, interleaved, make_model, parser, report

from sb3_dreamer_urlb import DreamerV2
from sb3_dreamer_urlb.output_reader import ending_with_its_reader

#: seconds that either may take
LIMIT = 3.0


def with_moments(model: DreamerV2) -> DreamerV2:
    """Let every optimiser step once, which is when its moments come to be."""
    for optimizer in model.learner.optimizers().values():
        optimizer.step(th.stack([parameter.square().sum() for parameter in optimizer.parameters]).sum())
    return model


def write(path: Path, content: bytes) -> None:
    """A file, on the disk."""
    with open(path, "wb") as file:
        file.write(content)
        os.fsync(file.fileno())


@ending_with_its_reader()
def main() -> None:
    """Time both."""
    options = parser(__doc__).parse_args()
    model = with_moments(make_model(options, intrinsic_reward="lbs", buffer_size=1000))
    with tempfile.TemporaryDirectory() as folder:
        snapshot, plain = Path(folder) / "model.zip", Path(folder) / "plain"
        model.save(snapshot)
        content = snapshot.read_bytes()
        work = {
            "save": lambda: model.save(snapshot),
            "load": lambda: DreamerV2.load(snapshot, env=NoiseImages(), device=model.device),
            "write": lambda: write(plain, content),
            "read": plain.read_bytes,
        }
        write(plain, content)
        times = interleaved(work, options, model.device)
    late = [f"{name} takes longer than {LIMIT:g} s" for name in ("save", "load") if min(times[name]) > LIMIT]
    amounts = {name: {"MB": len(content) / 1e6} for name in work}
    report("snapshot", times, {"save": Floor("write", 1), "load": Floor("read", 1)}, options, model.device, amounts, late)


if __name__ == "__main__":
    main()
