"""Where things lie: nobody else counts folders."""

from __future__ import annotations

import os
from pathlib import Path

HELPERS = Path(__file__).parent
TESTS = HELPERS.parent
ROOT = TESTS.parent
#: for programs that tests start: the package, the helpers, and the test files, whose functions they call
PYTHONPATH = os.pathsep.join(str(path) for path in (ROOT, HELPERS, *sorted(TESTS.iterdir())) if path.is_dir())


def file_of(name: str) -> Path:
    """The file ``test_<name>.py``, in whichever room.

    :raises ValueError: if there is none, or more than one
    """
    (found,) = TESTS.glob(f"*/test_{name}.py")
    return found
