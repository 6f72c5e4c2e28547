"""Keys of Stable-Baselines3 in the ``info`` of a step."""

from __future__ import annotations

#: the observation with which an episode ended; the one that the step returns begins the next
TERMINAL = "terminal_observation"
#: whether it was ended by a limit, and would have gone on
TRUNCATED = "TimeLimit.truncated"
