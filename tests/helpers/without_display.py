"""Programs that tests start without a display and without a word about OpenGL."""

from __future__ import annotations

import os
import subprocess
import sys

NO_GL = ("MUJOCO_GL", "PYOPENGL_PLATFORM", "DISPLAY", "WAYLAND_DISPLAY")


def run(code: str, **variables: str) -> str:
    """Run some Python in a fresh process without a display, and return what it printed."""
    environment = {name: value for name, value in os.environ.items() if name not in NO_GL} | variables
    environment["PYTHONPATH"] = os.pathsep.join(path for path in sys.path if path)
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()
