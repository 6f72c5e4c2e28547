"""Commands whose output nobody reads to its end, as before ``| head -1``: they end in silence, whatever else is printed."""

from __future__ import annotations

import ast
import os
import subprocess
import sys

import pytest
from places import ROOT

from sb3_dreamer_urlb.output_reader import STATUS, ending_with_its_reader

ENTRIES = [ROOT / "sb3_dreamer_urlb" / name for name in ("__main__.py", "zoo/__main__.py")]


def without_a_reader(*arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    """Run Python with a standard output that was closed before it began."""
    reader, writer = os.pipe()
    os.close(reader)
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"} | variables
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT), *(path for path in sys.path if path)])
    try:
        return subprocess.run(
            [sys.executable, *arguments], stdout=writer, stderr=subprocess.PIPE, text=True, env=environment, timeout=120
        )
    finally:
        os.close(writer)


@pytest.mark.parametrize(
    "command",
    [
        ["-m", "sb3_dreamer_urlb", "tasks"],
        ["-m", "sb3_dreamer_urlb", "--help"],
        ["-m", "sb3_dreamer_urlb", "--version"],
        ["-m", "sb3_dreamer_urlb.zoo", "--help"],
        [str(ROOT / "benchmarks" / "evidence.py"), "list"],
    ],
    ids=lambda command: "-".join(command[-2:]),
)
def test_a_command_ends_in_silence(command):
    done = without_a_reader(*command)
    assert (done.returncode, done.stderr) == (STATUS, "")


BODY = """
import sys
from sb3_dreamer_urlb.output_reader import ending_with_its_reader

@ending_with_its_reader()
def main():
    {}

main()
"""


@pytest.mark.parametrize("unbuffered", ["", "1"])
@pytest.mark.parametrize(
    "body", ["print('short')", "print('long' * 100_000)", "print('x', flush=True)", "print(1), sys.exit(3)"]
)
def test_whenever_it_is_written(body, unbuffered):
    done = without_a_reader("-c", BODY.format(body), PYTHONUNBUFFERED=unbuffered)
    assert (done.returncode, done.stderr) == (STATUS, "")


def test_nothing_else_is_hushed():
    done = without_a_reader("-c", BODY.format("raise ValueError('mine')"))
    assert done.returncode == 1 and "ValueError: mine" in done.stderr
    assert without_a_reader("-c", BODY.format("sys.exit(3)")).returncode == 3
    with pytest.raises(BrokenPipeError, match="a worker's"), ending_with_its_reader():
        raise BrokenPipeError("a worker's")


@pytest.mark.parametrize("path", [*ENTRIES, *sorted((ROOT / "benchmarks").glob("*.py"))], ids=lambda path: path.stem)
def test_every_command_of_the_repository_has_the_rule(path):
    for function in ast.parse(path.read_text()).body:
        if isinstance(function, ast.FunctionDef) and function.name == "main":
            assert "ending_with_its_reader()" in map(ast.unparse, function.decorator_list)
