"""Named sets of hyperparameters, in one place. The constructor's defaults are the benchmark's (URLB, Laskin et al., 2021)."""

from __future__ import annotations

from sb3_dreamer_urlb.algorithm.advice import IMAGES, VECTORS
from sb3_dreamer_urlb.algorithm.presets import Presets, with_presets

PRESETS: Presets = {
    # The constructor's own defaults: URLB's for pixels.
    "paper": {},
    # Runs on two CPU cores: a fifth of the paper's arithmetic an update.
    "small": {
        "learning_rate": 3e-4,
        "batch_size": 64,
        "learning_starts": 1000,
        "buffer_size": 100_000,
        "policy_kwargs": {"cnn_depth": 16, "net_arch": [256, 256]},
    },
    # Small tasks seen as vectors, on one CPU core: zoo_configs/drq_v2/vectors.yml.
    "vector": {
        "learning_rate": 1e-3,
        "batch_size": 128,
        "learning_starts": 500,
        "buffer_size": 100_000,
        "train_freq": 1,
        "policy_kwargs": {"net_arch": [128, 128]},
    },
    # For tests: everything runs, nothing is learnt.
    "tiny": {
        "batch_size": 4,
        "train_freq": 4,
        "learning_starts": 10,
        "buffer_size": 1000,
        "policy_kwargs": {"cnn_depth": 2, "feature_size": 4, "net_arch": [8]},
    },
}
#: the others serve everything; docs/notes/results.md says what "small" learns of vectors
MADE_FOR = {"small": (IMAGES,), "vector": (VECTORS,)}
#: fills a preset's hyperparameters in where a caller of the constructor left them out
with_preset = with_presets(PRESETS)
