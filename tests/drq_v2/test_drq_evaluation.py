"""DrQv2 in what the package evaluates with: rows, the command, films."""

from __future__ import annotations

import pytest
from fake_envs import CounterEnv
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_dreamer_urlb import DreamerV2, DrQv2, VideoCallback
from sb3_dreamer_urlb.evaluation.agent_rows import row_of
from sb3_dreamer_urlb.evaluation.episodes import run_evaluation
from sb3_dreamer_urlb.evaluation.loading import algorithm_of


def vec_env(**attributes):
    return DummyVecEnv([lambda: Monitor(CounterEnv(8, **attributes))])


def tiny(env, **kwargs):
    return DrQv2("CnnPolicy", env, preset="tiny", seed=0, device="cpu", **kwargs)


@pytest.mark.parametrize(("intrinsic", "method"), [(None, "drqv2"), ("disagreement", "disagreement")])
def test_rows_name_the_method_and_what_was_kept(intrinsic, method):
    env = vec_env(domain="jaco", action_repeat=2)
    model = tiny(env, intrinsic_reward=intrinsic).learn(24)
    if intrinsic:
        model.fine_tune()
        model.learn(16)
    played = run_evaluation(model, vec_env(domain="jaco"), 2)
    row = row_of(model, env, played)
    assert (row.method, row.planner, row.further["algorithm"]) == (method, "none", "DrQv2")
    assert (row.pretrain_frames, row.finetune_frames) == ((48, 32) if intrinsic else (0, 48))
    # The benchmark keeps the actor for jaco, too.
    assert row.keep_actor == (True if intrinsic else None)


def test_a_file_says_whose_it_is(tmp_path, tiny_model):
    tiny(vec_env()).save(tmp_path / "drq.zip")
    tiny_model().save(tmp_path / "dreamer.zip")
    found = [algorithm_of(tmp_path / f"{name}.zip") for name in ("drq", "dreamer")]
    assert found == [DrQv2, DreamerV2]


def test_films_show_the_agent(tmp_path):
    tiny(vec_env()).learn(24, VideoCallback(vec_env(), video_freq=10, folder=tmp_path))
    assert any(path.suffix == ".gif" for path in tmp_path.iterdir())
