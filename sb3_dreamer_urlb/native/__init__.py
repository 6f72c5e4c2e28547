"""Kernels of our own for CPUs, in C++, where torch's leave time on the table (docs/performance.md).

The sources stand in this folder. The first who needs them in a process has them compiled or finds them in the cache
(build.py); ops.py makes torch operators of them. Whoever has a choice of kernels asks :func:`active`, and the learner and the
policy say with :func:`using` when the answer is yes.
"""

from __future__ import annotations

import functools
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager

import torch as th

from sb3_dreamer_urlb.native import image_ops, ops, pixel_ops, planner_ops, product_ops, rollout_ops
from sb3_dreamer_urlb.native.build import NativeUnavailable, load

#: values of ``compile`` that use them
NATIVE = ("auto", "native")

_thread = threading.local()
_lock = threading.Lock()
_warned: set[str] = set()


@contextmanager
def using(compile: str, device: th.device | str) -> Iterator[None]:
    """Inside, in this thread, use the kernels where they are wanted and to be had, and nowhere else.

    :param compile: one of ``graphs.COMPILE``; ``"native"`` warns, once a process, where they cannot be had
    :param device: where the networks are
    """
    before = active()
    _thread.active = compile in NATIVE and _to_be_had(compile, device)
    try:
        yield
    finally:
        _thread.active = before


def active() -> bool:
    """Whether to use the kernels, here and now."""
    return getattr(_thread, "active", False)


def why_not(device: th.device | str = "cpu") -> str | None:
    """Why there are no kernels of ours, None where there are. Builds and loads them if nobody has yet, which takes seconds.

    :param device: where the networks are
    """
    if th.device(device).type != "cpu":
        return f"they are for the CPU, and the networks are on {th.device(device).type!r}"
    with _lock:
        return _why_not_loaded()


@functools.cache
def _why_not_loaded() -> str | None:
    try:
        ops.bind(load())
    except NativeUnavailable as error:
        return str(error)
    return None


def describe(compile: str, device: th.device | str) -> str:
    """A line for people: whose kernels run, and if torch's, why.

    :param compile: one of ``graphs.COMPILE``
    :param device: where the networks are
    """
    if compile not in NATIVE:
        return f"torch's (compile={compile!r})"
    reason = why_not(device)
    return "native where they are faster, torch's elsewhere" if reason is None else f"torch's ({reason})"


def on_lanes() -> bool:
    """Whether to use the kernels of ``planner_ops``, here and now: they pay on vectors of sixteen lanes (AVX-512)."""
    return active() and planner_ops.fast()


def _to_be_had(compile: str, device: th.device | str) -> bool:
    reason = why_not(device)
    if reason is not None and compile == "native" and reason not in _warned:
        _warned.add(reason)
        warnings.warn(f'compile="native" runs with torch\'s kernels, slower: {reason}')
    return reason is None
