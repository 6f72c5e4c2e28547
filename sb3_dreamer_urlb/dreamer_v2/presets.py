"""Named sets of hyperparameters, in one place.

The constructor's defaults are the paper's. A preset changes some of them; whatever a user writes out wins.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from sb3_dreamer_urlb.algorithm.advice import IMAGES, VECTORS
from sb3_dreamer_urlb.algorithm.presets import find_preset, with_presets
from sb3_dreamer_urlb.planning import Planner

PRESETS: dict[str, dict[str, Any]] = {
    # Paper appendix "Hyperparameters" and docs/algorithm.md: the constructor's own defaults.
    "paper": {},
    # Learns on two CPU cores, in thousands of updates instead of tens of thousands. Found by trial on walker stand, see
    # docs/notes/results.md: a faster actor saturates before the model is any good, and without the larger entropy bonus it
    # also stops exploring; the slow critic must keep up; so few samples need more of the actor's trajectories among them,
    # and until the model is good, acting with them only adds noise to the data.
    "small": {
        "learning_rate": 1e-3,
        "actor_learning_rate": 1e-4,
        "critic_learning_rate": 3e-4,
        "batch_size": 8,
        "batch_length": 32,
        "train_freq": 3,
        "learning_starts": 500,
        "buffer_size": 100_000,
        "ent_coef": 1e-3,
        "target_update_interval": 25,
        "planner_delay": 4500,
        "skill_selection_starts": 500,
        "planner_kwargs": {"n_samples": 64, "iterations": 6, "top_k": 8, "mixture": 0.5},
        "policy_kwargs": {
            "cnn_depth": 8,
            "deter_size": 128,
            "hidden_size": 128,
            "stoch_variables": 16,
            "stoch_classes": 16,
            "net_arch": [128] * 3,
        },
    },
    # Small tasks seen as vectors through VecNormalize (observations and rewards), on one CPU core: zoo_configs/vectors.yml.
    # Found by trial, see docs/notes/results.md. Few numbers say little in nats, so at the KL's full price the model stays
    # blurred. Sequences run on from one episode into the next, which lets them be longer than the shortest: with ten rows a
    # sequence, the model was lost after ten steps of acting. Many small categoricals average their noise away.
    "vector": {
        "learning_rate": 1e-3,
        "actor_learning_rate": 3e-4,
        "critic_learning_rate": 1e-3,
        "batch_size": 4,
        "batch_length": 32,
        "train_freq": 2,
        "learning_starts": 200,
        "buffer_size": 100_000,
        "replay_buffer_kwargs": {"sampling": "rows"},
        "ent_coef": 1e-3,
        "free_nats": 0.0,
        "kl_scale": 1e-3,
        "target_update_interval": 25,
        "planner_kwargs": {"n_samples": 64, "iterations": 6, "top_k": 8, "mixture": 0.5},
        "policy_kwargs": {
            "cnn_depth": 8,
            "deter_size": 64,
            "hidden_size": 64,
            "stoch_variables": 16,
            "stoch_classes": 8,
            "net_arch": [64] * 2,
        },
    },
    # dm_control tasks from states through VecNormalize(norm_reward=False): the paper's sizes and rates. Only the KL is
    # cheaper, for the reason given above: a state says less in nats than 64 x 64 pixels.
    "state": {"train_freq": 5, "kl_scale": 0.1, "policy_kwargs": {"deter_size": 200}},
    # The same on one CPU core; found by trial on the walker, docs/notes/states.md says what was measured. Whole episodes are
    # long enough for sequences that stay in one.
    "state-small": {
        "learning_rate": 6e-4,
        "actor_learning_rate": 2e-4,
        "critic_learning_rate": 3e-4,
        "batch_size": 8,
        "batch_length": 24,
        "train_freq": 5,
        "learning_starts": 1000,
        "buffer_size": 100_000,
        "ent_coef": 1e-3,
        "free_nats": 0.0,
        "kl_scale": 0.1,
        "target_update_interval": 10,
        "planner_kwargs": {"n_samples": 64, "iterations": 6, "top_k": 8, "mixture": 0.5},
        "policy_kwargs": {
            "cnn_depth": 8,
            "deter_size": 128,
            "hidden_size": 128,
            "stoch_variables": 16,
            "stoch_classes": 16,
            "net_arch": [128] * 2,
        },
    },
    # For tests: everything runs, nothing is learnt.
    "tiny": {
        "batch_size": 2,
        "batch_length": 4,
        "imagination_horizon": 3,
        "train_freq": 4,
        "learning_starts": 10,
        "planner_delay": 4,
        "skill_selection_starts": 15,
        "buffer_size": 1000,
        "planner_kwargs": {"n_samples": 8, "iterations": 2, "top_k": 4, "mixture": 0.25, "horizon": 3},
        "policy_kwargs": {
            "cnn_depth": 2,
            "deter_size": 8,
            "hidden_size": 8,
            "stoch_variables": 3,
            "stoch_classes": 4,
            "net_arch": [8],
        },
    },
}
#: the others serve everything; "small" was found on images, and in short runs was no worse on vectors (docs/notes/results.md)
MADE_FOR = {"small": (IMAGES, VECTORS), "vector": (VECTORS,), "state": (VECTORS,), "state-small": (VECTORS,)}
#: what a preset proposes, and phase and intrinsic reward decide (phases.py): the argument stays None
PROPOSED = ("ent_coef",)


def _left_alone(name: str, given: Mapping[str, Any]) -> bool:
    # A planner that is an object has its own settings.
    return name in PROPOSED or (name == "planner_kwargs" and isinstance(given.get("planner"), Planner))


#: fills a preset's hyperparameters in where a caller of the constructor left them out
with_preset = with_presets(PRESETS, _left_alone)


def get_preset(name: str) -> dict[str, Any]:
    """The hyperparameters that preset ``name`` changes.

    :raises ValueError: for an unknown name; the message lists the known ones
    """
    return find_preset(PRESETS, name)
