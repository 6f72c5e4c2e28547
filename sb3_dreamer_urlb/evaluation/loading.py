"""Whose a snapshot is, and an environment whose observations are normalised as the agent's were."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_dreamer_urlb.dreamer_v2 import DreamerV2
from sb3_dreamer_urlb.drq_v2 import DrQv2
from sb3_dreamer_urlb.snapshots import normalization, tensors
from sb3_dreamer_urlb.snapshots.archive import TENSORS, blaming, reading


def normalized_as_saved(env: VecEnv, snapshot: Path) -> VecEnv:
    """Wrap an environment in a VecNormalize with frozen statistics, if the agent needs one.

    :param env: to play in
    :param snapshot: of the agent; the checkpoint of a run folder holds the run's own statistics
    :return: the environment, wrapped or as it was
    :raises SnapshotError: naming the file and why it is refused
    """
    with reading(snapshot, "model") as archive:
        loaded = tensors.unpack(archive, TENSORS)
        stored = {name: value for name, value in loaded.items() if name.startswith(normalization.PREFIX)}
    if not stored:
        return env
    seen = any(name.startswith(f"{normalization.PREFIX}{normalization.OBSERVATION}") for name in stored)
    keys = sorted({name.split("/", 1)[1].rsplit(".", 1)[0] for name in stored if "/" in name}) or None
    with blaming(str(snapshot)):
        its = {**normalization.stored_settings(stored), "norm_reward": False}
        wrapped = VecNormalize(env, training=False, norm_obs=seen, norm_obs_keys=keys, **its)  # type: ignore[arg-type]
        normalization.restore(wrapped, stored)
    return wrapped


def algorithm_of(snapshot: Path) -> Any:
    """The class of the algorithm that wrote a snapshot.

    :param snapshot: of a model
    :raises SnapshotError: naming the file and why it is refused
    """
    known: tuple[Any, ...] = (DreamerV2, DrQv2)
    with reading(snapshot, "model") as archive:
        arguments = set(archive.data["arguments"])
    # Where none has them all, the first says what is wrong.
    return next((one for one in known if arguments <= set(one.argument_names())), known[0])
