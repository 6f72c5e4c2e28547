"""benchmarks/gpu.py, whose numbers need a GPU: every line of it runs without one, too."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest
import torch as th
from places import ROOT

SCRIPT = ROOT / "benchmarks" / "gpu.py"
SHORT = [
    "--preset=tiny", "--precision", "float32", "--repeat=1", "--env=noise", "--starts=110", "--warm-steps=115",
    "--chunk=4", "--run-seconds=0.1",
]  # fmt: skip


def run(*arguments):
    return subprocess.run([sys.executable, SCRIPT, *arguments], capture_output=True, text=True, timeout=280)


def test_the_script_runs_at_tiny_size_on_a_cpu(tmp_path):
    path = tmp_path / "gpu.json"
    done = run("--device=cpu", *SHORT, "--save", path)
    assert done.returncode == 0, done.stderr
    result = json.loads(path.read_text())
    rows = {row["name"]: row for row in result["rows"]}
    for name in (
        "update, pre-training (LBS), float32",
        "planned action, 10 environments, float32",
        "actor alone, 1 environment",
    ):
        for mode in ("graphs", "eager"):
            assert any(row.startswith(name) and row.endswith(mode) and rows[row]["value"] > 0 for row in rows), name
    # Both were eager here, and said so.
    assert rows["10 updates, graphs and eager, float32: weights apart"]["value"] == 0
    assert any("needs a CUDA device" in note for note in result["notes"])
    assert not any("failed" in note for note in result["notes"])
    for phase in ("pre-training", "fine-tuning"):
        assert any(name.startswith(phase) and rows[name]["unit"] == "frames/s" and rows[name]["value"] > 0 for name in rows)
    assert "target ≥ 450: " in done.stdout and "took" in done.stdout


@pytest.mark.skipif(th.cuda.is_available(), reason="needs a machine without a GPU")
def test_without_a_gpu_it_says_so():
    done = run()
    assert done.returncode == 2 and "needs a CUDA device" in done.stdout and "--device cpu --preset tiny" in done.stdout
