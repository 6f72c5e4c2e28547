"""The zoo in an empty folder."""

from __future__ import annotations

import sys
import warnings

import gymnasium
import pytest
from gymnasium.envs.registration import EnvSpec
from zoo_commands import CHEAP, FLIP, STAND

from sb3_dreamer_urlb.zoo.__main__ import main


@pytest.fixture
def zoo(tmp_path, monkeypatch):
    """Run a command of the zoo in an empty folder; in this process, which is faster."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["zoo"])
    monkeypatch.setenv("MPLBACKEND", "Agg")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    for name in (STAND, FLIP):
        monkeypatch.setitem(gymnasium.registry, name, EnvSpec(name, "fake_envs:CounterEnv", kwargs=CHEAP))

    def run(*arguments: str) -> None:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", ".*not of the same type.*")
            assert main(arguments) == 0

    return run
