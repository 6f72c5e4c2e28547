"""Whether CartPole and Pendulum are learnt from vectors: the check itself is slow, its script is tried at tiny size."""

from __future__ import annotations

import importlib.util
import sys

import numpy as np
import pytest
from places import ROOT

from sb3_dreamer_urlb.dreamer_v2.presets import PRESETS

SCRIPT = ROOT / "benchmarks" / "vector_tasks.py"
#: least mean return of 20 deterministic episodes; random actions give 22 and -1200
LEAST = {"CartPole-v1": 300.0, "Pendulum-v1": -250.0}


@pytest.fixture
def vector_tasks(monkeypatch):
    """The benchmark as a module."""
    spec = importlib.util.spec_from_file_location("vector_tasks", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "vector_tasks", module)  # where dataclasses look
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.timeout(0)  # minutes of CPU time
@pytest.mark.parametrize("task", LEAST)
def test_it_is_learnt_in_minutes(vector_tasks, task):
    run = vector_tasks.learn(task, seed=0)
    assert run.scores.mean() >= LEAST[task], run.scores
    assert run.seconds < 600


@pytest.mark.parametrize("task", LEAST)
def test_the_script_writes_the_curves(vector_tasks, monkeypatch, tmp_path, capsys, task):
    monkeypatch.setitem(PRESETS, "vector", PRESETS["tiny"])
    steps = {"CartPole-v1": 150, "Pendulum-v1": 420}[task]
    options = ["--seeds", "3", "4", "--steps", str(steps), "--episodes", "1", "--out", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["vector_tasks.py", task, *options])
    vector_tasks.main()
    printed = capsys.readouterr().out
    assert f"{task} seed 3: " in printed and f"{task} seed 4: " in printed
    stem = vector_tasks.stem(task)
    for seed in (3, 4):
        rows = np.loadtxt(tmp_path / f"{stem}_{seed}.csv", delimiter=",", skiprows=1, ndmin=2)
        assert len(rows) >= 2 and rows.shape[1] == 3 and (np.diff(rows[:, 0]) > 0).all() and rows[-1, 0] <= steps
        assert (np.diff(rows[:, 1]) >= 0).all() and (rows[:, 2] > 0).all() == (task == "CartPole-v1")
    assert (tmp_path / f"{stem}.png").read_bytes().startswith(b"\x89PNG")
