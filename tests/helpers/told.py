"""What this package tells its users, apart from what the rest of the process happens to warn of."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def told_meanwhile() -> Iterator[list[str]]:
    """The texts of the warnings for users that come within the block; the list is filled when it ends.

    Not of others: the garbage collector says at any moment that an earlier test left a file open.
    """
    texts: list[str] = []
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        yield texts
    texts += [str(one.message) for one in caught if issubclass(one.category, UserWarning)]
