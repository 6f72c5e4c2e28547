"""Settings of VecNormalize in files: what plays alone has them, what has others of its own is told."""

from __future__ import annotations

import numpy as np
import pytest
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize
from told import told_meanwhile

from sb3_dreamer_urlb import DreamerV2, RunCheckpointCallback
from sb3_dreamer_urlb.evaluation.loading import normalized_as_saved
from sb3_dreamer_urlb.snapshots import normalization

UNUSUAL = {"clip_obs": 0.3, "epsilon": 1e-3, "clip_reward": 2.0, "gamma": 0.5, "norm_reward": False}


def normalized(**settings):
    return VecNormalize(make_vec_env("Pendulum-v1", 1), **settings)


def learnt(env, steps=24, **kwargs):
    model = DreamerV2("MlpPolicy", env, preset="tiny", seed=0, device="cpu")
    return model.learn(steps, **kwargs)


def test_an_agent_alone_is_shown_what_it_learnt_from(tmp_path):
    model = learnt(normalized(**UNUSUAL))
    model.save(tmp_path / "model.zip")
    shown = normalized_as_saved(make_vec_env("Pendulum-v1", 1), tmp_path / "model.zip")
    assert isinstance(shown, VecNormalize)
    seen = np.array([[5.0, -5.0, 0.1]], np.float32)
    its = model.get_vec_normalize_env()
    assert np.array_equal(shown.normalize_obs(seen), its.normalize_obs(seen)) and abs(shown.normalize_obs(seen)).max() <= 0.3
    assert {name: getattr(shown, name) for name in UNUSUAL} == UNUSUAL


@pytest.mark.parametrize("name", normalization.SETTING_NAMES)
def test_what_goes_on_behind_other_settings_is_told_so(tmp_path, name):
    learnt(normalized()).save(tmp_path / "model.zip")
    for settings in ({}, {name: UNUSUAL[name]}):
        with told_meanwhile() as said:
            DreamerV2.load(tmp_path / "model.zip", env=normalized(**settings), device="cpu")
        wrong = [text for text in said if "other numbers for the same state" in text]
        # A reward is no observation.
        assert len(wrong) == (bool(settings) and name in normalization.OF_OBSERVATIONS)
        paid = [text for text in said if "of another scale" in text]
        assert len(paid) == (bool(settings) and name in normalization.OF_REWARDS)
        assert all(f"VecNormalize({name}={UNUSUAL[name]:g})" in text for text in [*wrong, *paid])


def test_an_agent_that_explores_is_paid_by_nobody(tmp_path):
    model = DreamerV2("MlpPolicy", normalized(), preset="tiny", intrinsic_reward="lbs", seed=0, device="cpu")
    model.learn(24).save(tmp_path / "model.zip")
    with told_meanwhile() as said:
        loaded = DreamerV2.load(tmp_path / "model.zip", env=normalized(norm_reward=False), device="cpu")
        loaded.fine_tune(normalized(gamma=0.5))
    assert not any("scale" in text for text in said)


def test_settings_of_rewards_that_nobody_normalises_are_no_matter(tmp_path):
    learnt(normalized(norm_reward=False)).save(tmp_path / "model.zip")
    with told_meanwhile() as said:
        DreamerV2.load(tmp_path / "model.zip", env=normalized(norm_reward=False, gamma=0.5, clip_reward=1.0), device="cpu")
    assert not any("scale" in text for text in said)


@pytest.mark.parametrize("name", normalization.SETTING_NAMES)
def test_a_run_keeps_them(tmp_path, name):
    def go(steps, **settings):
        learnt(normalized(**settings), steps, callback=RunCheckpointCallback(tmp_path / "run", resume="auto"))

    go(24)
    go(32)
    wrong = rf"normalises with VecNormalize\({name}=.*VecNormalize\({name}="
    with pytest.warns(UserWarning, match=wrong) if name == "gamma" else pytest.raises(ValueError, match=wrong):
        go(40, **{name: UNUSUAL[name]})
    go(48)


def test_no_bounds_and_older_files(tmp_path):
    model = learnt(normalized(clip_obs=np.inf))
    model.save(tmp_path / "model.zip")
    again = DreamerV2.load(tmp_path / "model.zip", device="cpu")
    assert normalization.differing(again.known_statistics(), model.get_vec_normalize_env()) is None
    older = normalization.pack(model.get_vec_normalize_env())
    assert normalization.differing(older, normalized(clip_obs=1.0)) is None


@pytest.mark.parametrize("settings", [th.zeros(5), th.zeros(4, dtype=th.float64), -th.ones(5, dtype=th.float64)])
def test_others_are_refused(settings):
    with pytest.raises(ValueError, match="settings of its VecNormalize"):
        normalization.stored_settings({normalization.SETTINGS: settings})
