"""The algorithms that rl_zoo3 gets from here: their names, classes, searches and default configurations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from sb3_dreamer_urlb.algorithm.agent_algorithm import AgentAlgorithm
from sb3_dreamer_urlb.dreamer_v2 import DreamerV2
from sb3_dreamer_urlb.drq_v2 import DrQv2
from sb3_dreamer_urlb.zoo.sampler import convert_params, sample_dreamer_v2_params, sample_drq_v2_params


@dataclass(frozen=True)
class ZooAlgorithm:
    """One of them.

    :param kind: its class
    :param sampler: what ``-optimize`` tries
    :param configs: what ``train`` reads without ``-conf``: the first of these that knows the environment
    :param converter: from a study's numbers to constructor arguments
    """

    kind: type[AgentAlgorithm]
    sampler: Callable[..., dict[str, Any]]
    configs: tuple[str, ...]
    converter: Callable[[dict[str, Any]], dict[str, Any]] = convert_params


#: by what stands behind ``--algo``; the hub looks for the class's name in lower case, as ``dreamerv2``
ALGORITHMS = {
    "dreamerv2": ZooAlgorithm(DreamerV2, sample_dreamer_v2_params, ("lbs.yml", "vectors.yml")),
    "drq_v2": ZooAlgorithm(DrQv2, sample_drq_v2_params, ("drq_v2/disagreement.yml", "drq_v2/vectors.yml")),
}
