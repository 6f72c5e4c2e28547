"""What a run will take, and a shorter one where that is too long."""

from __future__ import annotations

import pytest
from fake_envs import CounterEnv
from hypothesis import given
from hypothesis import strategies as st

from sb3_dreamer_urlb.callbacks.snapshot import SnapshotCallback
from sb3_dreamer_urlb.cli import demo_pixels, pace
from sb3_dreamer_urlb.cli.demo_pixels import DemoConfig
from sb3_dreamer_urlb.cli.pace import Amount, Pace


def test_a_phase_counts_warm_up_updates_and_plans(tiny_model):
    model = tiny_model(CounterEnv(action_repeat=2), learning_starts=10, train_freq=4, planner_delay=6)
    assert pace.phase(model, 100, plans=True) == Amount(50, 10, 34)
    assert pace.phase(model, 100, plans=False) == Amount(50, 10, 0)
    assert pace.phase(model, 7, plans=True) == Amount(4, 0, 0)
    assert (Amount(50, 10, 34) + Amount(4, 0, 0)).seconds(
        Pace(1.0, 0.5, 0.25, 0.125)
    ) == 54 * 0.125 + 34 * 0.5 + 20 * 0.25 + 10


@pytest.mark.parametrize("planned", [1, 12])
def test_parts_are_timed(tiny_model, monkeypatch, planned):
    model, rows = tiny_model(planner="dyna_mpc", intrinsic_reward="lbs"), set()
    choose = model.policy.choose

    def choosing(state, **kwargs):
        rows.add((model.policy.planning, len(state.steps)))
        return choose(state, **kwargs)

    monkeypatch.setattr(model.policy, "choose", choosing)
    found = pace.measure(model, CounterEnv(8), planned)
    assert min(found.update, found.plan, found.act, found.step) > 0
    assert rows == {(True, planned), (False, 1)}


@given(st.floats(0.01, 1e5), st.floats(0.01, 1e5), st.floats(0.05, 0.9))
def test_a_share_fits_or_is_the_least(whole, limit, least):
    share = pace.shrink(lambda share: share * whole, limit, least)
    assert least <= share <= 1
    assert share * whole <= limit * 1.001 or share == pytest.approx(least)
    assert share == 1 or share == pytest.approx(least) or share * whole >= limit * 0.999


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.2, "about 1 second"), (75, "about 75 seconds"), (840, "about 14 minutes"), (9000, "about 2.5 hours")],
)
def test_durations_in_words(seconds, words):
    assert pace.in_words(seconds) == words


@given(st.floats(0.1, 50), st.integers(1, 10), st.integers(1, 10))
def test_what_is_left_follows_the_pace_so_far(slower, first, further):
    """Two seconds a frame, three after the last of 20, all of it slower than expected; the start is no pace."""
    left = pace.Left(lambda frames: 2.0 * frames, 3.0, 20)
    assert left.seconds(first, 1e4) is None
    assert left.seconds(first, 2e4) is None  # nothing was learnt meanwhile
    done = first + further
    now = 1e4 + slower * 2 * further
    assert left.seconds(done, now) == pytest.approx(slower * (2 * (20 - done) + 3))


def test_too_little_learning_is_no_pace():
    left = pace.Left(lambda frames: 2.0 * frames, 3.0, 1000)
    assert left.seconds(1, 0.0) is None and left.seconds(40, 1e6) is None
    assert left.seconds(61, 240.0) == pytest.approx(2 * (2 * 939 + 3))


def fitted(monkeypatch, config, update):
    monkeypatch.setattr(pace, "measure", lambda *_: Pace(update, 0.0, 0.0, 0.0))
    env = CounterEnv(120, domain="walker", action_repeat=2)
    return demo_pixels.fitted(config, env)


def test_a_slow_machine_takes_smaller_numbers_and_says_so(monkeypatch, capsys):
    config = DemoConfig(preset="tiny")
    assert fitted(monkeypatch, config, 0.001) == config
    printed = capsys.readouterr().out
    assert "in place of" not in printed and "will take about 2 seconds" in printed
    slow = fitted(monkeypatch, config, 1.5)
    assert config.pretrain_frames > slow.pretrain_frames >= demo_pixels.LEAST * config.pretrain_frames
    assert config.finetune_frames > slow.finetune_frames and slow.episodes == 1
    printed = capsys.readouterr().out
    assert f"{slow.pretrain_frames} and {slow.finetune_frames} frames in place of 3000 and 12000" in printed
    assert "would take about 47 minutes" in printed and "will take about 25 minutes" in printed
    slowest = fitted(monkeypatch, config, 100.0)
    assert (slowest.pretrain_frames, slowest.finetune_frames) == (900, 3600)


@pytest.mark.parametrize("update", [0.001, 0.9, 1.5, 100.0])
def test_frames_stay_whole_numbers_that_callbacks_take(monkeypatch, tmp_path, update):
    config = fitted(monkeypatch, DemoConfig(preset="tiny"), update)
    assert all(type(number) is int for number in (config.pretrain_frames, config.finetune_frames))
    SnapshotCallback(tmp_path, [config.pretrain_frames])


def test_numbers_that_somebody_gave_stay(monkeypatch):
    config = DemoConfig(pretrain_frames=4000, episodes=7, preset="tiny")
    slow = fitted(monkeypatch, config, 100.0)
    assert (slow.pretrain_frames, slow.episodes, slow.finetune_frames) == (4000, 7, 3600)
