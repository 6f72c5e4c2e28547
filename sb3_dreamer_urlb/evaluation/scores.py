"""Published returns that normalise scores, and the scores (paper, appendix A, "Normalization scores").

The numbers are data of the package: ``reference.csv`` and ``published.csv``, each with its source in its first lines.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from pathlib import Path

_DATA = Path(__file__).parent


def _table(name: str) -> list[dict[str, str]]:
    lines = (_DATA / name).read_text(encoding="utf-8").splitlines()
    return list(csv.DictReader(line for line in lines if not line.startswith("#")))


def _column(name: str) -> dict[str, float]:
    return {f"{line['domain']}-{line['task']}": float(line[name]) for line in _table("reference.csv")}


#: Return of Dreamer trained on each task for 2M frames: the oracle that normalises scores.
ORACLE: dict[str, float] = _column("dreamer_2m")

DREAMER_2M, URLB_EXPERT = "dreamer_2m", "urlb_expert"
#: what scores are shares of → return of each task: Dreamer@2M, as the paper; the expert of URLB, as Disagreement's 39.0 %
NORMALIZERS: dict[str, dict[str, float]] = {DREAMER_2M: ORACLE, URLB_EXPERT: _column("urlb_expert")}


@dataclass(frozen=True)
class Published:
    """A published return.

    :param mean: over seeds
    :param error: its standard error
    """

    mean: float
    error: float


def published_returns(name: str) -> dict[str, Published]:
    """Returns of a method by task, as published.

    :param name: ``"ours"`` (LBS, task-aware fine-tuning, Dyna-MPC) or ``"disagreement"``
    :raises ValueError: for another name
    """
    if name not in ("ours", "disagreement"):
        raise ValueError(f"Published are 'ours' and 'disagreement', got {name!r}.")
    mean, error = _column(name), _column(f"{name}_se")
    return {task: Published(mean[task], error[task]) for task in mean}


def published_scores() -> dict[str, Published]:
    """Normalised score of the whole benchmark by approach, in percent, as the paper's first table gives it."""
    return {
        line["approach"]: Published(float(line["score"]), float(line["standard_error"])) for line in _table("published.csv")
    }


def normalized_score(task: str, episode_return: float, normalizer: str = DREAMER_2M) -> float:
    """Return as a share of a reference's.

    :param task: ``<domain>-<task>``, a key of ``ORACLE``
    :param episode_return: undiscounted return of one episode, or a mean of such
    :param normalizer: a key of :data:`NORMALIZERS`
    :raises ValueError: for an unknown task or normaliser
    """
    return episode_return / reference(task, normalizer)


def oracle(task: str) -> float:
    """Return of the oracle.

    :param task: ``<domain>-<task>``, a key of ``ORACLE``
    :raises ValueError: for an unknown task
    """
    return reference(task, DREAMER_2M)


def reference(task: str, normalizer: str) -> float:
    """Return that is a score of 1.

    :param task: ``<domain>-<task>``, a key of ``ORACLE``
    :param normalizer: a key of :data:`NORMALIZERS`
    :raises ValueError: for an unknown task or normaliser
    """
    if normalizer not in NORMALIZERS:
        raise ValueError(f"Unknown normalizer {normalizer!r}; known are {sorted(NORMALIZERS)}.")
    if task not in ORACLE:
        raise ValueError(f"Unknown task {task!r}; known are {sorted(ORACLE)}.")
    return NORMALIZERS[normalizer][task]
