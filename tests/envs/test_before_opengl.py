"""Triton is loaded before any OpenGL library, where there is one: the other way round the process ends.

What stands for Triton here notes which libraries were there when it was imported.
"""

from __future__ import annotations

import sys

import pytest
from without_display import run

TRITON = """
import re
maps = open("/proc/self/maps").read()
print("OpenGL was there:", sorted(set(re.findall(r"/lib(EGL|OSMesa|GL|OpenGL|LLVM)[-.\\w]*$", maps, re.MULTILINE))))
"""
FIRST_FRAME = """
import sys
sys.path.insert(0, {folder!r})
from sb3_dreamer_urlb.envs import make_urlb_env
env = make_urlb_env("walker", "run")
env.reset()
assert "OpenGL" in sys.modules
"""
PACKAGE = """
import sys
sys.path.insert(0, {folder!r})
from sb3_dreamer_urlb import DreamerV2
assert "triton" in sys.modules or {broken}
"""


def put(folder, text):
    (folder / "triton").mkdir()
    (folder / "triton" / "__init__.py").write_text(text)


@pytest.mark.skipif(sys.platform != "linux", reason="asks Linux what is loaded")
@pytest.mark.parametrize("code", [FIRST_FRAME, PACKAGE], ids=["the first frame", "the package"])
def test_it_comes_before(code, tmp_path):
    put(tmp_path, TRITON)
    assert run(code.format(folder=str(tmp_path), broken=False)) == "OpenGL was there: []"


def test_a_broken_one_stops_nothing(tmp_path):
    put(tmp_path, "raise RuntimeError('no driver')")
    assert run(PACKAGE.format(folder=str(tmp_path), broken=True)) == ""
