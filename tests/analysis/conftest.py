"""Tiny agents before and after a fine-tuning, in an environment of their own."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from counter_task import ENV
from stable_baselines3.common.env_util import make_vec_env

from sb3_dreamer_urlb import DreamerV2


@pytest.fixture(scope="session")
def snapshots(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Make a pre-trained snapshot, once for each method."""
    folder = tmp_path_factory.mktemp("snapshots")

    def make(method: str = "lbs", **kwargs: Any) -> Path:
        name = "-".join([method, *(f"{key}-{value}" for key, value in sorted(kwargs.items()))])
        path = folder / f"{name}.zip"
        if not path.exists():
            env = make_vec_env(ENV, 1)
            settings = {"preset": "tiny", "seed": 0, "device": "cpu", "intrinsic_reward": method, **kwargs}
            DreamerV2("CnnPolicy", env, **settings).learn(28).save(path)
        return path

    return make


@pytest.fixture(scope="session")
def tuned(snapshots: Callable[..., Path]) -> Path:
    """What the LBS snapshot became, its decoder frozen."""
    path = snapshots().with_name("tuned.zip")
    model = DreamerV2.load(snapshots(), env=make_vec_env(ENV, 1), device="cpu", freeze_decoder=True)
    model.fine_tune()
    model.learn(28).save(path)
    return path
