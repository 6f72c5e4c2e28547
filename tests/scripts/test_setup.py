"""scripts/setup.sh, with a virtual environment whose Python only notes down what it is asked for."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
INDEX = "https://example.org/whl/cpu"
#: of an environment's Python: notes its arguments; pip fails where a file named "unreachable" lies beside it
NOTING = """#!/usr/bin/env bash
echo "$*" >>"$(dirname "$0")/calls"
! [[ "$*" == *--index-url* && -f $(dirname "$0")/unreachable ]]
"""


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """All that setup.sh reads, and an environment that counts as made."""
    for name in ("setup.cfg", "pyproject.toml", "constraints.txt", "sb3_dreamer_urlb/version.txt", "scripts/setup.sh"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / name)
    binaries = tmp_path / ".venv" / "bin"
    binaries.mkdir(parents=True)
    (binaries / "python").write_text(NOTING)
    (binaries / "python").chmod(0o755)
    (tmp_path / ".venv" / ".location").write_text(f"{tmp_path}\n")
    return tmp_path


def set_up(checkout: Path, torch_index: str) -> tuple["subprocess.CompletedProcess[str]", list[str]]:
    """What it said, and its calls of pip that install something."""
    environment = {**os.environ, "TORCH_INDEX": torch_index, "VENV": ".venv"}
    done = subprocess.run(["bash", "scripts/setup.sh"], cwd=checkout, env=environment, capture_output=True, text=True)
    calls = (checkout / ".venv" / "bin" / "calls").read_text().splitlines()
    return done, [call for call in calls if " install " in call and "--dry-run" not in call]


def test_only_torch_comes_from_its_index(checkout):
    done, (torch, rest) = set_up(checkout, INDEX)
    assert done.returncode == 0, done.stderr
    assert torch.endswith(" torch") and f"--index-url {INDEX}" in torch and "--no-deps" in torch
    assert INDEX not in rest and "-e .[dev,plots,zoo]" in rest


def test_without_an_index_there_is_one_installation(checkout):
    done, calls = set_up(checkout, "")
    assert done.returncode == 0, done.stderr
    assert len(calls) == 1 and "index-url" not in calls[0]


def test_an_index_out_of_reach_ends_it_and_is_named(checkout):
    (checkout / ".venv" / "bin" / "unreachable").touch()
    done, calls = set_up(checkout, INDEX)
    assert done.returncode == 1 and f"TORCH_INDEX={INDEX}" in done.stderr
    assert len(calls) == 1 and not (checkout / ".venv" / ".installed").exists()
