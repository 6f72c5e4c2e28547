"""``--help`` of every program of the repository tells what it is, and begins nothing."""

from __future__ import annotations

import subprocess
import sys

import pytest
from places import ROOT

PROGRAMS = [
    path
    for folder in ("scripts", "benchmarks")
    for path in sorted((ROOT / folder).glob("*.py"))
    if "__main__" in path.read_text()
]


@pytest.mark.parametrize("path", PROGRAMS, ids=lambda path: f"{path.parent.name}/{path.name}")
def test_it_explains_itself(path, tmp_path):
    done = subprocess.run([sys.executable, path, "--help"], capture_output=True, text=True, cwd=tmp_path, timeout=300)
    assert done.returncode == 0 and "usage:" in done.stdout, done.stderr
    assert "``" not in done.stdout
    assert not list(tmp_path.iterdir())
