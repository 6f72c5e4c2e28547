"""Which errors are a user's mistakes, and how a command tells one: in a line, without a traceback."""

from __future__ import annotations

import sys


def is_a_mistake(error: Exception) -> bool:
    """Whether an error is about what somebody asked for: arguments, files and folders, packages, environments.

    :param error: that a command raised
    """
    # Pipes to processes of our own: nobody asked for anything wrong.
    if isinstance(error, ConnectionError):
        return False
    # An argument for an environment that it does not have, as Gymnasium tells it.
    if isinstance(error, TypeError) and all(part in str(error) for part in ("unexpected keyword", "environment creator")):
        return True
    # Only what is loaded can have raised: a command that needs no environment does not wait for Gymnasium.
    gymnasium = sys.modules.get("gymnasium")
    return isinstance(error, ValueError | ImportError | OSError) or (
        gymnasium is not None and isinstance(error, gymnasium.error.Error)
    )


def tell(program: str, error: Exception) -> None:
    """Print a mistake to standard error.

    :param program: name of the command, which begins the line
    :param error: whose text and notes are put into one line
    """
    text = " ".join([str(error), *getattr(error, "__notes__", ())])
    print(f"{program}: {' '.join(text.split())}", file=sys.stderr)
