"""The command that tries every exploration method, and the faults that it would find."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from fake_envs import CounterEnv
from gymnasium import spaces

from sb3_dreamer_urlb.__main__ import main
from sb3_dreamer_urlb.cli.methods_tour import TourConfig, Visit, run_tour

EIGHT = ("icm", "plan2explore", "rnd", "lbs", "apt", "diayn", "aps", "random")


@pytest.fixture
def cheap_walker(monkeypatch):
    """Environments that cost nothing."""

    def make(name, **kwargs):
        return CounterEnv(30, action_space=spaces.Box(-1, 1, (6,), np.float32), domain="walker", action_repeat=2)

    monkeypatch.setattr(gymnasium, "make", make)


def test_all_eight(cheap_walker, tmp_path, capsys):
    config = TourConfig(
        tmp_path, EIGHT, pretrain_frames=120, finetune_frames=80, episodes=1, preset="tiny", jobs=1, log_every=4
    )
    visits = run_tour(config)
    assert [seen.method for seen in visits] == list(EIGHT)
    for seen in visits:
        assert seen.updates > 0 and len(seen.returns) == 1 and (tmp_path / f"{seen.method}_120.zip").exists()
        assert (len(seen.reward) > 1) == (seen.method != "random")
        assert len(seen.loss) == (0 if seen.method in ("random", "apt") else 2)
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["method", *EIGHT, "Random"]


def test_faults_are_found():
    good = Visit("lbs", 9, [1.0, 2.0], [0.1, 0.2], [3.0, 2.0], [10.0])
    assert good.faults() == []
    assert Visit("lbs", 9, [1.0, float("nan")], [0.1, 0.2], [3.0, 2.0], [10.0]).faults() == ["not finite"]
    assert Visit("lbs", 9, [1.0, 1.0], [0.1, 0.0], [3.0, 2.0], [10.0]).faults() == ["constant reward"]
    assert Visit("lbs", 9, [1.0, 1.0], [0.1, 0.1], [1.0, 2.0], [10.0]).faults() == ["module did not learn"]


def test_bad_input(capsys):
    with pytest.raises(ValueError, match=r"Unknown methods \['lbz'\]; known are .*'lbs'"):
        TourConfig(methods=("lbz",))
    with pytest.raises(ValueError, match=r"Unknown task 'walker-jump'; known are .*walker-run"):
        TourConfig(task="walker-jump")
    with pytest.raises(ValueError, match="jobs must be positive, got 0"):
        TourConfig(jobs=0)
    assert main(["methods", "--methods", "lbz"]) == 2 and "Unknown methods" in capsys.readouterr().err
