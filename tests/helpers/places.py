"""Where things lie: nobody else counts folders."""

from __future__ import annotations

import os
from pathlib import Path

HELPERS = Path(__file__).parent
TESTS = HELPERS.parent
ROOT = TESTS.parent
#: for programs that tests start: the package and the helpers
PYTHONPATH = os.pathsep.join([str(ROOT), str(HELPERS)])


def test_file(name: str) -> Path:
    """The file ``test_<name>.py``, in whichever room.

    :raises ValueError: if there is none, or more than one
    """
    (found,) = TESTS.glob(f"*/test_{name}.py")
    return found
