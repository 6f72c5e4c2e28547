"""Runs Stable-Baselines3's and sb3-contrib's own tests with an algorithm of ours where their lists say SAC or TQC: a plugin.

The commands stand in docs/sb3.md. Networks are tiny and rows are replayed across episodes, or nothing would be learnt in the
hundred steps that those tests take.
"""

from __future__ import annotations

import importlib
import os
from typing import Any

import sb3_dreamer_urlb

#: sizes of SAC's and TQC's networks, which the tests choose for those algorithms only
OF_THEIR_NETWORKS = ("n_critics", "n_quantiles", "features_extractor_kwargs")


def tiny(kwargs: dict[str, Any]) -> dict[str, Any]:
    """What a test asks for, without what it asks of SAC's networks, and tiny where it says nothing."""
    if isinstance(sizes := kwargs.get("policy_kwargs"), dict):
        kwargs["policy_kwargs"] = {name: value for name, value in sizes.items() if name not in OF_THEIR_NETWORKS}
    return {"preset": "tiny", **kwargs}


class DreamerV2(sb3_dreamer_urlb.DreamerV2):
    """Tiny, unless a test says otherwise."""

    def __init__(self, *args: Any, replay_buffer_kwargs: Any = None, **kwargs: Any):
        replay_buffer_kwargs = {"sampling": "rows", **(replay_buffer_kwargs or {})}
        super().__init__(*args, replay_buffer_kwargs=replay_buffer_kwargs, **tiny(kwargs))


class DrQv2(sb3_dreamer_urlb.DrQv2):
    """Likewise."""

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **tiny(kwargs))


ours = {"DreamerV2": DreamerV2, "DrQv2": DrQv2}[os.environ.get("IN_PLACE", "DreamerV2")]
for package, name in (("stable_baselines3", "SAC"), ("sb3_contrib", "TQC")):
    try:
        setattr(importlib.import_module(package), name, ours)
    except ImportError:
        continue
