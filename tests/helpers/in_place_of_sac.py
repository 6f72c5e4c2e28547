"""Runs Stable-Baselines3's and sb3-contrib's own tests with DreamerV2 where their lists say SAC or TQC: a plugin for pytest.

The commands stand in docs/sb3.md. Networks are tiny and rows are replayed across episodes, or nothing would be learnt in the
hundred steps that those tests take.
"""

from __future__ import annotations

import importlib
from typing import Any

import sb3_dreamer_urlb

#: sizes of SAC's and TQC's networks, which the tests choose for those algorithms only
OF_THEIR_NETWORKS = ("n_critics", "n_quantiles", "features_extractor_kwargs")


class DreamerV2(sb3_dreamer_urlb.DreamerV2):
    """Tiny, unless a test says otherwise."""

    def __init__(self, *args: Any, preset: str = "tiny", replay_buffer_kwargs: Any = None, **kwargs: Any):
        replay_buffer_kwargs = {"sampling": "rows", **(replay_buffer_kwargs or {})}
        if isinstance(sizes := kwargs.get("policy_kwargs"), dict):
            kwargs["policy_kwargs"] = {name: value for name, value in sizes.items() if name not in OF_THEIR_NETWORKS}
        super().__init__(*args, preset=preset, replay_buffer_kwargs=replay_buffer_kwargs, **kwargs)


for package, name in (("stable_baselines3", "SAC"), ("sb3_contrib", "TQC")):
    try:
        setattr(importlib.import_module(package), name, DreamerV2)
    except ImportError:
        continue
