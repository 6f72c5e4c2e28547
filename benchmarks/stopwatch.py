"""Where the time of a loop goes: calls are timed by part, nested ones only once."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import torch as th
from common import CLOCKS

OTHER = "other"


class Stopwatch:
    """Sums times by part; what no part claims is ``OTHER``.

    On a GPU the host waits at the border of each part, so that each pays for its own kernels. That is the price of the
    shares: where host and device overlap, the sum is larger than without.

    :param clock: key of ``CLOCKS``
    :param device: that works
    """

    def __init__(self, clock: str, device: th.device):
        self.clock, self.device = CLOCKS[clock], device
        self.seconds: dict[str, float] = {}
        self.running = False
        self._parts = [OTHER]
        self._since = 0.0

    def start(self) -> None:
        """From zero."""
        self._synchronize()
        self.seconds, self.running, self._since = {}, True, self.clock()

    def stop(self) -> dict[str, float]:
        """Part → seconds since the start."""
        self._book()
        self.running = False
        return self.seconds

    def _synchronize(self) -> None:
        if self.device.type == "cuda":
            th.cuda.synchronize(self.device)

    def _book(self) -> None:
        """The time since the last border goes to the innermost part."""
        if not self.running:
            return
        self._synchronize()
        now = self.clock()
        self.seconds[self._parts[-1]] = self.seconds.get(self._parts[-1], 0.0) + now - self._since
        self._since = now

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """What runs inside belongs to that part, but for parts inside."""
        self._book()
        self._parts.append(name)
        try:
            yield
        finally:
            self._book()
            self._parts.pop()

    def watch(self, owner: Any, method: str, part: str | Callable[[], str]) -> None:
        """Count all calls of an object's method to a part.

        :param owner: object
        :param method: its name
        :param part: the part, or what tells it at each call
        """
        inner = getattr(owner, method)

        @functools.wraps(inner)
        def timed(*args: Any, **kwargs: Any) -> Any:
            with self.part(part() if callable(part) else part):
                return inner(*args, **kwargs)

        setattr(owner, method, timed)
