"""What a command does when whoever reads its output closes the pipe, as ``head`` does once it has seen enough."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Iterator
from contextlib import contextmanager

#: exit status that a shell gives a program that SIGPIPE ended
STATUS = 141


@contextmanager
def ending_with_its_reader() -> Iterator[None]:
    """End in silence when nobody reads standard output any more; around a block, or as ``@ending_with_its_reader()``.

    Not by the signal, which would also end a program whose own processes die: their pipes' errors pass through.

    :raises SystemExit: with ``STATUS``
    """
    try:
        try:
            yield
        finally:
            if sys.stdout is not None and not sys.stdout.closed:
                sys.stdout.flush()
    except BrokenPipeError:
        if not _has_gone():
            raise
        # Python flushes once more when it ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise SystemExit(STATUS) from None


def _has_gone() -> bool:
    """Whether nobody reads standard output any more."""
    try:
        outputs = select.poll()
        outputs.register(sys.stdout.fileno(), 0)
    except (OSError, ValueError):  # no file of the system's
        return False
    return any(event & (select.POLLERR | select.POLLHUP) for _, event in outputs.poll(0))
