"""The one evaluation: fixed seeds in any VecEnv, with or without the planner, and what a row says about it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch as th
from fake_envs import CounterEnv
from gymnasium import spaces
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_dreamer_urlb import DreamerV2, DrQv2
from sb3_dreamer_urlb.evaluation.agent_rows import env_columns, row_of
from sb3_dreamer_urlb.evaluation.append import append_row
from sb3_dreamer_urlb.evaluation.arms import Study
from sb3_dreamer_urlb.evaluation.curves import selected
from sb3_dreamer_urlb.evaluation.episodes import run_evaluation
from sb3_dreamer_urlb.evaluation.protocol import RandomPolicy, evaluate, play_episode
from sb3_dreamer_urlb.evaluation.rows import read_rows
from sb3_dreamer_urlb.evaluation.settings import settings_of


class SeedEnv(gymnasium.Env):
    """Its reward is the seed of the episode, its length follows from it: what was played can be told."""

    observation_space = spaces.Box(-1, 1, (2,), np.float32)
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        self.value, self.steps = -1 if seed is None else seed, 0
        return np.zeros(2, np.float32), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        return np.ones(2, np.float32), float(self.value), False, self.steps >= 2 + self.value % 3, {}


class Still:
    """A model of anybody's."""

    def predict(self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False) -> Any:
        return np.zeros((len(observation), 1), np.float32), None


def seeds(count: int, vec_env: Any = DummyVecEnv) -> Any:
    kwargs = {"start_method": "forkserver"} if vec_env is SubprocVecEnv else {}
    return vec_env([SeedEnv] * count, **kwargs)


@pytest.mark.parametrize(("count", "vec_env"), [(1, DummyVecEnv), (3, DummyVecEnv), (10, DummyVecEnv), (2, SubprocVecEnv)])
def test_the_same_episodes_in_any_vec_env(count: int, vec_env: Any) -> None:
    env = seeds(count, vec_env)
    played = run_evaluation(Still(), env, episodes=7, seed=50)
    env.close()
    assert played.lengths == [2 + (50 + i) % 3 for i in range(7)]
    assert played.returns == [(50 + i) * length for i, length in enumerate(played.lengths)]
    assert (played.planner, played.seed) == ("none", 50)
    assert played.mean == pytest.approx(np.mean(played.returns)) and played.std == pytest.approx(np.std(played.returns))


def test_a_vec_normalize_neither_moves_nor_counts() -> None:
    env = VecNormalize(seeds(2), clip_reward=1.0)
    played = run_evaluation(Still(), env, episodes=2, seed=50)
    assert played.returns == [50 * 4, 51 * 2]
    assert env.training and env.obs_rms.count == pytest.approx(1e-4) and env.ret_rms.count == pytest.approx(1e-4)


def test_a_monitor_below_a_wrapper_that_changes_rewards_counts() -> None:
    env = DummyVecEnv([lambda: gymnasium.wrappers.TransformReward(Monitor(SeedEnv()), lambda reward: 0.0)])
    assert run_evaluation(Still(), env, episodes=1, seed=51).returns == [51 * 2]


def test_it_equals_sb3_s_loop_and_our_own(tiny_model: Any) -> None:
    model = tiny_model(CounterEnv(20))
    own = run_evaluation(model, DummyVecEnv([lambda: Monitor(CounterEnv(20))]), episodes=2)
    sb3, _ = evaluate_policy(model, Monitor(CounterEnv(20)), 2, return_episode_rewards=True, warn=False)
    assert own.returns == pytest.approx(sb3)
    assert own.returns == pytest.approx(evaluate(model, CounterEnv(20), 2))


def test_training_s_random_draws_stay_untouched(tiny_model: Any) -> None:
    model = tiny_model()
    before = th.get_rng_state()
    run_evaluation(model, DummyVecEnv([CounterEnv]), episodes=1, deterministic=False)
    assert th.equal(before, th.get_rng_state())


def test_an_evaluation_can_be_repeated(tiny_model: Any) -> None:
    model, env = tiny_model(SeedEnv(), "MlpPolicy"), seeds(2)
    first = run_evaluation(model, env, episodes=3, deterministic=False)
    th.manual_seed(7)
    assert run_evaluation(model, env, episodes=3, deterministic=False).returns == first.returns


def test_the_planner_is_switched_for_the_evaluation_only(tiny_model: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    model = tiny_model(planner="dyna_mpc", planner_delay=0, learning_starts=0)
    planned: list[bool] = []
    choose = model.policy.choose

    def watched(*arguments: Any) -> Any:
        planned.append(model.policy.planning)
        return choose(*arguments)

    monkeypatch.setattr(model.policy, "choose", watched)
    before = model.policy.planning
    for planner, plans in (("on", True), ("off", False), ("auto", True)):
        planned.clear()
        played = run_evaluation(model, DummyVecEnv([lambda: CounterEnv(3)]), episodes=1, planner=planner)
        assert planned == [plans] * 3 and played.planner == ("dyna_mpc" if plans else "none")
    assert model.policy.planning is before
    model.planner_delay = 100
    assert run_evaluation(model, DummyVecEnv([lambda: CounterEnv(3)]), episodes=1).planner == "none"


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"episodes": 0}, "episodes must be an integer of at least 1, got 0"),
        ({"seed": -1}, "seed must be an integer of at least 0"),
        ({"planner": "maybe"}, "planner must be one of .*'maybe'"),
        ({"planner": "on"}, "planner='on': Still has no planner"),
    ],
)
def test_bad_input(kwargs: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        run_evaluation(Still(), seeds(1), **kwargs)


def test_a_row_says_who_played_where(tiny_model: Any, tmp_path: Any) -> None:
    model = tiny_model(CounterEnv(20, domain="jaco", action_repeat=2), intrinsic_reward="apt", intrinsic_kwargs={"k": 3})
    model.learn(32)
    env = DummyVecEnv([lambda: CounterEnv(20, domain="jaco", task="reach_top_left")])
    pretrained = row_of(model, env, run_evaluation(model, env, 1))
    assert (pretrained.pretrain_frames, pretrained.finetune_frames, pretrained.keep_actor) == (64, 0, None)
    model.fine_tune()
    model.learn(12)
    row = row_of(model, env, run_evaluation(model, env, 2), arm="mine")
    assert (row.method, row.domain, row.task, row.seed) == ("apt", "jaco", "reach_top_left", 0)
    assert (row.pretrain_frames, row.finetune_frames, row.preset, row.episodes) == (64, 24, "tiny", 2)
    assert (row.keep_actor, row.keep_critic, row.planner) == (False, False, "none")
    assert row["arm"] == "mine" and "torch" in row["versions"] and len(row["returns"].split()) == 2
    append_row(tmp_path / "rows.csv", row)
    assert read_rows(tmp_path / "rows.csv").rows[0].key == row.key


@pytest.mark.parametrize(("actor", "critic", "reward"), [(True, True, False), (False, False, True), (None, False, False)])
def test_a_snapshot_remembers_what_its_fine_tuning_kept(
    tiny_model: Any, tmp_path: Any, actor: bool | None, critic: bool, reward: bool
) -> None:
    model = tiny_model(CounterEnv(20, domain="walker", action_repeat=2), intrinsic_reward="lbs").learn(32)
    model.fine_tune(keep_actor=actor, keep_critic=critic, keep_reward=reward)
    model.save(tmp_path / "tuned.zip")
    env = DummyVecEnv([lambda: CounterEnv(20, domain="walker", task="run")])
    loaded = DreamerV2.load(tmp_path / "tuned.zip", env=env, device="cpu")
    row = row_of(loaded, env, run_evaluation(loaded, env, 1))
    # The paper keeps the walker's.
    assert (row.keep_actor, row.keep_critic) == (actor is not False, critic)
    assert row["known_reward"] == ("true" if reward else "")
    given = row_of(loaded, env, run_evaluation(loaded, env, 1), keep_actor=False, keep_critic=False)
    assert (given.keep_actor, given.keep_critic) == (False, False)
    loaded.kept = None
    unknown = row_of(loaded, env, run_evaluation(loaded, env, 1))
    assert (unknown.keep_actor, unknown.keep_critic) == (None, None)


def test_a_row_about_somebody_else_s_model() -> None:
    model = PPO("MlpPolicy", "Pendulum-v1", seed=3, n_steps=8, batch_size=8)
    env = make_vec_env("Pendulum-v1", 1)
    row = row_of(model, env, run_evaluation(model, env, 1))
    assert (row.method, row.domain, row.task, row.seed, row.keep_actor) == ("ppo", "gymnasium", "Pendulum", 3, None)


def test_columns_of_the_environment() -> None:
    env = make_vec_env("urlb/dm_control-v0", 1, env_kwargs={"domain": "cartpole", "task": "balance"})
    assert env_columns(env) == {"domain": "cartpole", "task": "balance"}
    env.close()


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({}, None),
        ({"render_mode": "rgb_array"}, None),
        ({"max_episode_steps": 60}, "max_episode_steps=60"),
        ({"max_episode_steps": 60, "action_repeat": 4}, "action_repeat=4, max_episode_steps=60"),
    ],
)
def test_another_task_under_the_same_id_has_a_column(changes: dict[str, Any], told: str | None) -> None:
    env = make_vec_env("urlb/walker-run-v0", 1, env_kwargs={"observation": "state", **changes})
    expected = {"domain": "walker", "task": "run", "observation": "state"}
    assert env_columns(env) == (expected if told is None else {**expected, "environment": told})
    env.close()


@pytest.mark.parametrize("kind", [DummyVecEnv, SubprocVecEnv])
@pytest.mark.parametrize("wrapper", [Monitor, gymnasium.wrappers.RecordEpisodeStatistics])
def test_an_environment_without_an_id_is_called_after_its_class(kind: Any, wrapper: Any) -> None:
    env = VecNormalize(kind([lambda: wrapper(CounterEnv(5))]), norm_obs=False)
    assert env_columns(env) == {"domain": "gymnasium", "task": "CounterEnv"}
    env.close()


def test_random_actions_for_comparison() -> None:
    env = CounterEnv(20)
    assert evaluate(RandomPolicy(env.action_space), env, 1) == [pytest.approx(sum((0.0, 1.0, 0.5)[i % 3] for i in range(20)))]


def test_an_agent_that_learnt_behind_vec_normalize_is_shown_what_it_knows(tmp_path: Path) -> None:
    def normalized() -> VecNormalize:
        return VecNormalize(make_vec_env("Pendulum-v1", 1), norm_reward=False)

    model = DreamerV2("MlpPolicy", normalized(), preset="tiny", seed=0, device="cpu").learn(40)
    env = gymnasium.make("Pendulum-v1")
    expected = run_evaluation(model, normalized(), 2).returns
    # The random draws of a batch are others than those of one environment, in what is drawn anew in each episode.
    assert evaluate(model, env, 2) == pytest.approx(expected, rel=1e-4)
    seen = play_episode(model, env, seed=3).observations
    assert isinstance(seen, np.ndarray) and not (np.abs(seen[:, :2]) <= 1).all()
    with pytest.raises(ValueError, match="take one environment, got the vectorised VecNormalize"):
        evaluate(model, normalized(), 1)  # type: ignore[arg-type]
    model.save(tmp_path / "model")
    with pytest.raises(ValueError, match="loaded without an environment that has one"):
        evaluate(DreamerV2.load(tmp_path / "model"), env, 1)


@pytest.mark.parametrize(
    ("algorithm", "preset"),
    [(kind, preset) for kind in (DreamerV2, DrQv2) for preset in kind.presets if preset not in ("paper", "state")],
)
def test_a_preset_alone_has_no_settings(algorithm: Any, preset: str) -> None:
    for kwargs in ({}, {"intrinsic_reward": "disagreement" if algorithm is DrQv2 else "lbs"}):
        model = algorithm("MlpPolicy", "Pendulum-v1", preset=preset, seed=3, device="cpu", verbose=1, **kwargs)
        assert settings_of(model) == {}


def test_other_hyperparameters_are_another_run(tmp_path: Path) -> None:
    other = {
        "batch_size": 5,
        "learning_rate": 0.1,
        "policy_kwargs": {"net_arch": [4, 4]},
        "replay_buffer_kwargs": {"sampling": "rows"},
        "train_freq": (1, "episode"),
    }
    text = "batch_size:5;learning_rate:0.1;policy_kwargs.net_arch:4/4;replay_buffer_kwargs.sampling:rows;train_freq:1/episode"
    env = make_vec_env("Pendulum-v1", 1)
    for kwargs, expected in (({}, ""), (other, text)):
        model = DreamerV2("MlpPolicy", "Pendulum-v1", preset="tiny", seed=0, device="cpu", **kwargs)
        model.save(tmp_path / "model")
        for one in (model, DreamerV2.load(tmp_path / "model", device="cpu")):
            row = row_of(one, env, run_evaluation(one, env, 1))
            assert row["settings"] == expected
        append_row(tmp_path / "rows.csv", row)
    rows = read_rows(tmp_path / "rows.csv", strict=False).rows
    assert len(rows) == 2 and len(Study(rows).mixtures()) == 1 and "settings is" in Study(rows).mixtures()[0]
    assert selected(rows, f"settings={text}").rows == (rows[1],)
    assert settings_of(PPO("MlpPolicy", "Pendulum-v1")) == {}
