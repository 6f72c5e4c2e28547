"""Environments that do not keep to their spaces or to Gymnasium's interface: the error says what finds the breach."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

#: what Python and numpy raise over answers of another form than was promised
RAISED = (TypeError, ValueError, LookupError, AttributeError, AssertionError, RuntimeError, EOFError, ConnectionError)
NOTE = (
    "It was raised while the environments were asked to {what}. stable_baselines3.common.env_checker.check_env(env) tells "
    "whether an environment keeps to its spaces and to Gymnasium's interface."
)


@contextmanager
def asking_to(what: str) -> Iterator[None]:
    """Around a question to environments, in whose errors their own author is not at hand.

    :param what: they are asked to do, for the note that the errors get
    """
    try:
        yield
    except RAISED as error:
        annotate(error, what)
        raise


def annotate(error: BaseException, what: str) -> None:
    """Add the note, once.

    :param error: of an environment
    :param what: it was asked to do
    """
    notes, note = getattr(error, "__notes__", []), NOTE.format(what=what)
    if note not in notes:
        # What Exception.add_note does from Python 3.11 on; 3.10 prints no notes, and commands do.
        error.__notes__ = [*notes, note]  # type: ignore[attr-defined]
