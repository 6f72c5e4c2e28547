"""Reference returns of the twelve tasks (paper, appendix A, table "Normalization scores")."""

from __future__ import annotations

#: Return of Dreamer trained on each task for 2M frames: the oracle that normalises scores.
ORACLE: dict[str, float] = {
    "walker-flip": 778,
    "walker-run": 724,
    "walker-stand": 909,
    "walker-walk": 965,
    "quadruped-jump": 753,
    "quadruped-run": 904,
    "quadruped-stand": 945,
    "quadruped-walk": 947,
    "jaco-reach_bottom_left": 223,
    "jaco-reach_bottom_right": 231,
    "jaco-reach_top_left": 233,
    "jaco-reach_top_right": 225,
}


def normalized_score(task: str, episode_return: float) -> float:
    """Return as a share of the oracle's.

    :param task: ``<domain>-<task>``, a key of ``ORACLE``
    :param episode_return: undiscounted return of one episode, or a mean of such
    :raises ValueError: for an unknown task
    """
    return episode_return / oracle(task)


def oracle(task: str) -> float:
    """Return of the oracle.

    :param task: ``<domain>-<task>``, a key of ``ORACLE``
    :raises ValueError: for an unknown task
    """
    if task not in ORACLE:
        raise ValueError(f"Unknown task {task!r}; known are {sorted(ORACLE)}.")
    return ORACLE[task]
