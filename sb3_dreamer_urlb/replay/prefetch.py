"""Work done ahead of time, in a thread."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any, Generic, TypeVar

Result = TypeVar("Result")


class Prefetcher(Generic[Result]):
    """Does one thing ahead of time, for whoever comes to take it.

    Its thread starts when it is first needed, and ends with :meth:`close`, with this object, or with the process. Copies of
    this object, by pickle or by ``fork``, begin with nothing.
    """

    def __init__(self) -> None:
        self._executor: ThreadPoolExecutor | None = None
        self._pending: tuple[Any, Future[Result]] | None = None
        self._process = os.getpid()

    def __reduce__(self) -> tuple[Any, ...]:
        return Prefetcher, ()

    def begin(self, key: Any, work: Callable[[], Result]) -> None:
        """Start.

        :param key: what the result depends on
        :param work: gives it
        """
        self.discard()
        if self._executor is None:
            self._executor = ThreadPoolExecutor(1, "prefetch")
        self._pending = key, self._executor.submit(work)

    def take(self, key: Any) -> Result | None:
        """Wait for what was begun.

        :param key: what the result should depend on
        :return: the result; None if there is none, or one of another key, which is dropped
        :raises Exception: what the work raised
        """
        self._forget_after_fork()
        if self._pending is None or self._pending[0] != key:
            self.discard()
            return None
        (_, future), self._pending = self._pending, None
        return future.result()

    def discard(self) -> None:
        """Drop what was begun, error or not; once this returns, the thread is at rest."""
        self._forget_after_fork()
        if self._pending is not None:
            (_, future), self._pending = self._pending, None
            if not future.cancel():
                wait([future])

    def close(self) -> None:
        """End the thread. May be called again; :meth:`begin` starts another one."""
        self.discard()
        if self._executor is not None:
            self._executor.shutdown()
            self._executor = None

    def _forget_after_fork(self) -> None:
        # A forked child has no thread, and would wait for it for ever.
        if self._process != os.getpid():
            self._process, self._executor, self._pending = os.getpid(), None, None
