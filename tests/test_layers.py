"""The rooms of the package: imports point downwards, nothing goes in a circle, and every module has its place."""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = "sb3_dreamer_urlb"


def lint(folder: Path) -> subprocess.CompletedProcess[str]:
    program = "import sys; from importlinter.cli import lint_imports_command; sys.exit(lint_imports_command())"
    command = [sys.executable, "-c", program, "--no-cache", "--no-logo", str(ROOT / ".importlinter")]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True)


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """The package's sources, to be spoilt."""
    shutil.copytree(ROOT / PACKAGE, tmp_path / PACKAGE, ignore=shutil.ignore_patterns("__pycache__", "*.cpp", "*.h"))
    return tmp_path


def test_the_contracts_hold() -> None:
    done = lint(ROOT)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "2 kept, 0 broken" in done.stdout


@pytest.mark.parametrize(
    ("module", "line"),
    [
        ("learning/optim.py", "from sb3_dreamer_urlb.dreamer_v2 import DreamerV2"),
        ("snapshots/tensors.py", "if TYPE_CHECKING:\n    from sb3_dreamer_urlb.dreamer_v2 import DreamerV2"),
        ("behavior/returns.py", "def late():\n    import sb3_dreamer_urlb.world_model.world_model"),
        ("spaces/raw.py", "from sb3_dreamer_urlb.spaces.observations import Images"),
    ],
    ids=["upwards", "upwards for the type checker alone", "beside, late", "in a circle within a room"],
)
def test_an_import_that_points_elsewhere_breaks_them(copy: Path, module: str, line: str) -> None:
    path = copy / PACKAGE / module
    path.write_text(f"{path.read_text()}\nfrom typing import TYPE_CHECKING\n{line}\n")
    done = lint(copy)
    assert done.returncode == 1 and f".{Path(module).stem} -> " in done.stdout


def test_a_module_without_a_place_breaks_them(copy: Path) -> None:
    (copy / PACKAGE / "helpers.py").write_text("")
    done = lint(copy)
    assert done.returncode == 1 and "helpers" in done.stdout


def test_what_lies_below_the_algorithms_names_none_of_them() -> None:
    layers = (ROOT / ".importlinter").read_text().split("layers =\n")[1].split("\n[")[0].splitlines()
    rooms = [line.strip() for line in layers if line.strip() and not line.strip().startswith("#")]
    below = [room for line in rooms[rooms.index("dreamer_v2 | drq_v2") + 1 :] for room in line.split(" | ")]
    files = [path for room in below for path in (ROOT / PACKAGE).rglob("*") if _room(path) == room]
    assert {"algorithm", "agent", "spaces", "_moved"} <= set(below) and len(files) > 100
    found = [str(path) for path in files if path.suffix in (".py", ".cpp", ".h") and NAMES.search(path.read_text())]
    assert not found, f"These name an algorithm that stands above them: {found}"


NAMES = re.compile(r"\b(DreamerV2|DrQv2)\b")


def _room(path: Path) -> str:
    return path.relative_to(ROOT / PACKAGE).parts[0].removesuffix(".py")


def test_only_one_place_knows_how_to_install() -> None:
    """No message names a package index or a clone by itself (docstrings may say which extra a feature is)."""
    told = []
    for path in sorted((ROOT / PACKAGE).rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        documented = [node for node in ast.walk(tree) if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)]
        skipped = {id(node.value) for node in documented}
        for node in ast.walk(tree):
            if isinstance(node, ast.Constant) and id(node) not in skipped and "pip install" in str(node.value):
                told.append(str(path.relative_to(ROOT / PACKAGE)))
    assert set(told) == {"version.py"}
