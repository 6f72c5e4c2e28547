"""Errors with a meaning of their own."""

from __future__ import annotations


class UnsupportedSpaceError(ValueError, AssertionError):
    """An observation or action space that an agent cannot learn in.

    A ``ValueError`` like every other wrong argument, and the ``AssertionError`` that Stable-Baselines3 raises for spaces.
    """
