"""How commands end: a user's mistake costs a line and exit status 2, Ctrl-C a line and 130; all else keeps its traceback."""

from __future__ import annotations

import sys
from collections.abc import Callable

from sb3_dreamer_urlb.mistakes import is_a_mistake, tell

MISTAKE, INTERRUPTED = 2, 130


def ending_in_a_line(program: str, command: Callable[[], int]) -> int:
    """Run a command.

    :param program: its name, which begins the line
    :param command: gives its exit status; a ``KeyboardInterrupt`` with a text says how to go on
    :return: exit status
    """
    try:
        return command()
    except KeyboardInterrupt as interruption:
        print(f"{program}: {' '.join(map(str, interruption.args)) or 'interrupted.'}", file=sys.stderr)
        return INTERRUPTED
    except Exception as error:
        if not is_a_mistake(error):
            raise
        tell(program, error)
        return MISTAKE
