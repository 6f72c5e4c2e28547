"""DreamerV2 as a member of the Stable-Baselines3 family: learning, saving, logging, seeds, presets."""

from __future__ import annotations

import io
import warnings

import numpy as np
import pytest
import torch as th
from fake_envs import CounterEnv, counter
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.utils import LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize, VecTransposeImage

from sb3_dreamer_urlb import DreamerV2
from sb3_dreamer_urlb.dreamer_v2.presets import PRESETS
from sb3_dreamer_urlb.intrinsic import get_intrinsic_reward, registered_intrinsic_rewards

SPACES = {
    "lopsided": spaces.Box(np.array([-3.0, 1.0], np.float32), np.array([0.5, 1.5], np.float32)),
    "matrix": spaces.Box(-2, 5, (2, 3), np.float32),
    "float64": spaces.Box(-0.25, 4, (1,), np.float64),
}


def vec_env(n_envs, *lengths, **kwargs):
    return DummyVecEnv([lambda: Monitor(CounterEnv(lengths or 8, **kwargs))] * n_envs)


def optimizer_bytes(model):
    return {
        (name, index, key): value.numpy().tobytes()
        for name, optimizer in model.learner.optimizers().items()
        for index, state in optimizer.state_dict()["state"].items()
        for key, value in state.items()
    }


class Stopper(BaseCallback):
    """Ends ``learn`` at a step."""

    def __init__(self, last):
        super().__init__()
        self.last = last

    def _on_step(self):
        return self.num_timesteps < self.last


# -- learning --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("terminates", [True, False])
@pytest.mark.parametrize("method", ["lbs", None])
def test_learn(tiny_model, weights, n_envs, terminates, method):
    model = tiny_model(vec_env(n_envs, 5, 8, 12, terminates=terminates), intrinsic_reward=method, planner="dyna_mpc")
    before = weights(model.policy)
    assert model.learn(60) is model
    assert model.num_timesteps >= 60 and model.phase_timesteps == model.num_timesteps
    assert model._n_updates == model.phase_updates == model.learner.updates > 3
    after = weights(model.policy)
    trained = {name.split(".")[1] for name in before if before[name] != after[name]}
    expected = {"world_model", "actor", "critic", "slow_critic"}
    assert trained == expected | ({"intrinsic", "reward_normalizer"} if method else set())
    assert all(th.isfinite(value).all() for value in model.policy.state_dict().values())
    ends = [episode.is_terminal for episode in model.replay_buffer.episodes]
    assert all(end[-1] == terminates and not end[:-1].any() for end in ends)


def test_the_discount_head_is_built_unless_the_environment_never_terminates(tiny_model):
    assert tiny_model().policy.agent.world_model.discount_logit is not None
    assert tiny_model(CounterEnv(never_terminates=True)).policy.agent.world_model.discount_logit is None
    asked = tiny_model(CounterEnv(never_terminates=True), discount_head=True)
    assert asked.policy.agent.world_model.discount_logit is not None


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("noise", [True, False])
@pytest.mark.parametrize("name", SPACES)
@pytest.mark.parametrize("method", ["lbs", None])
def test_the_stored_action_is_the_executed_one(tiny_model, n_envs, noise, name, method):
    space = SPACES[name]
    size = spaces.flatdim(space)
    envs = [CounterEnv(6, action_space=space) for _ in range(n_envs)]
    action_noise = NormalActionNoise(np.zeros(size), np.full(size, 0.8)) if noise else None
    model = tiny_model(
        DummyVecEnv([lambda i=i: envs[i] for i in range(n_envs)]), action_noise=action_noise, intrinsic_reward=method
    )
    model.learn(24 * n_envs)
    stored = list(model.replay_buffer.episodes)
    assert len(stored) == 4 * n_envs
    for k, episode in enumerate(stored):
        env = envs[k % n_envs]
        received = np.array(env.received[k // n_envs])
        assert all(action.dtype == space.dtype and space.contains(action) for action in env.received[k // n_envs])
        scaled = model.policy.scale_action(received).reshape(6, size)
        assert np.allclose(episode.action[1:], scaled, atol=1e-5) and not episode.action[0].any()
        assert np.array_equal(np.diff(counter(episode.observation)), np.ones(6))
        assert np.allclose(episode.reward, [0, 0, 1, 0.5, 0, 1, 0.5])
    assert np.abs(np.concatenate([e.action for e in stored])).max() <= 1


def test_the_acting_state_is_reset_with_the_episode_and_remembers_the_noisy_action(tiny_model, monkeypatch):
    model = tiny_model(vec_env(2, 5, 7), action_noise=NormalActionNoise(np.zeros(2), np.ones(2)))
    seen = []
    original = model.policy.observe

    def spy(observation, state, is_first, generator=None):
        seen.append((is_first.tolist(), state.action.clone(), counter(observation.numpy())))
        return original(observation, state, is_first, generator)

    monkeypatch.setattr(model.policy, "observe", spy)
    model.learn(40)
    # Lengths 5, 7, 5, 7 in both environments, a reset's frame more each.
    starts = [t for t, (is_first, *_) in enumerate(seen) if any(is_first)]
    assert starts == [0, 5, 12, 17] and all(seen[t][0] == [True, True] for t in starts)
    episode = model.replay_buffer.episodes[0]
    assert all(np.allclose(seen[t][1][0], episode.action[t], atol=1e-6) for t in range(1, 5))


def _transposed_then_normalized():
    return VecNormalize(VecTransposeImage(vec_env(2, 8)), norm_obs=False)


@pytest.mark.parametrize(
    "make_env",
    [
        _transposed_then_normalized,
        pytest.param(lambda: VecNormalize(vec_env(2, 8), norm_obs=False)),
    ],
)
def test_vec_normalize_scales_rewards_when_they_are_drawn(tiny_model, make_env):
    env = make_env()
    model = tiny_model(env).learn(60)
    assert model.get_vec_normalize_env() is env and model._n_updates > 0
    episodes = model.replay_buffer.episodes
    assert np.unique(np.concatenate([episode.reward for episode in episodes])).tolist() == [0.0, 0.5, 1.0]  # raw
    assert all(np.array_equal(np.diff(counter(episode.observation)), np.ones(8)) for episode in episodes)
    drawn = model.replay_buffer.sample(50, env=env).reward.unique()
    expected = np.array([0.0, 0.5, 1.0]) / np.sqrt(env.ret_rms.var + env.epsilon)
    assert np.allclose(drawn, expected, rtol=1e-5)


def test_vec_normalize_of_images_is_refused(tiny_model):
    with pytest.raises(ValueError, match="CnnPolicy needs image observations"):
        tiny_model(VecNormalize(vec_env(1, 8), norm_obs=True))


@pytest.mark.parametrize(
    ("kwargs", "updates"),
    [
        ({"train_freq": (1, "episode"), "gradient_steps": 2}, 2 * 5),  # episodes end at 8, …, 48; from 16 on they train
        ({"train_freq": (2, "episode"), "gradient_steps": -1}, 3 * 16),
        ({"train_freq": 4, "gradient_steps": -1}, 10 * 4),  # at 12, 16, …, 48
        ({"train_freq": (4, "step"), "gradient_steps": 3}, 10 * 3),
        ({"train_freq": 4, "gradient_steps": 0}, 0),
    ],
)
def test_train_freq_and_gradient_steps(tiny_model, kwargs, updates):
    model = tiny_model(vec_env(1, 8), **kwargs).learn(48)
    assert model.num_timesteps == 48 and model._n_updates == updates


def test_learning_rate_schedules(tiny_model):
    rates = {"learning_rate": 1e-2, "actor_learning_rate": 1e-3, "critic_learning_rate": 1e-4}
    schedules = {name: (lambda remaining, rate=rate: rate * remaining) for name, rate in rates.items()}
    model = tiny_model(vec_env(1, 8), intrinsic_reward="lbs", weight_decay=1e-3, **schedules)
    model.learn(100, callback=Stopper(40))
    optimizers = model.learner.optimizers()
    remaining = 1 - 40 / 100  # at the last update
    for name, rate in (("model", 1e-2), ("intrinsic", 1e-2), ("actor", 1e-3), ("critic", 1e-4)):
        optimizer = optimizers[f"{name}_optimizer"]
        assert float(optimizer.adam.param_groups[0]["lr"]) == pytest.approx(rate * remaining)
        assert optimizer.weight_decay == 1e-3


def test_a_schedule_never_makes_a_learning_rate_negative(tiny_model):
    model = tiny_model(vec_env(1, 8), learning_rate=lambda remaining: 1e-2 * remaining).learn(41)
    assert model.learner.model_optimizer.adam.param_groups[0]["lr"] >= 0


@pytest.mark.parametrize("method", ["lbs", None])
def test_warm_up(tiny_model, method):
    """Pre-training begins with uniform actions, fine-tuning with the actor; neither updates before ``learning_starts``."""
    env = CounterEnv(8)
    model = tiny_model(env, intrinsic_reward=method, learning_starts=60)
    with th.no_grad():
        model.policy.agent.actor.body.out.bias.fill_(-20.0)
        model.policy.agent.actor.out_std.bias.fill_(-20.0)
    model.learn(60)
    assert model._n_updates == 0
    actions = np.array([action for episode in env.received for action in episode])
    if method:
        assert actions.min() < -0.8 and actions.max() > 0.8 and abs(actions.mean()) < 0.2
    else:
        assert actions.max() < -0.5
    model.learn(8)
    assert model._n_updates == 2 and all(np.max(episode) < -0.5 for episode in env.received[-2:] if episode)


def test_repeated_learn_keeps_the_phases_counters_and_does_not_warm_up_again(tiny_model, monkeypatch):
    model = tiny_model(CounterEnv(8), intrinsic_reward="lbs")
    sampled = []
    monkeypatch.setattr(model.action_space, "sample", lambda: sampled.append(1) or np.zeros(2, np.float32))
    for times in (1, 2, 3):
        model.learn(20)
        assert model.num_timesteps == 20 and model.phase_timesteps == 20 * times
    assert len(sampled) == 10  # learning_starts
    updates = model._n_updates
    model.learn(4, reset_num_timesteps=False)
    assert model.num_timesteps == 24 and model.phase_timesteps == 64 and model._n_updates == updates + 1
    assert model.phase_updates == model._n_updates


def test_a_reset_between_two_learn_calls_ends_the_open_episode(tiny_model):
    model = tiny_model(CounterEnv(100))
    model.learn(8)
    assert not model.replay_buffer.can_sample()
    model.learn(8)
    (closed,) = model.replay_buffer.episodes
    assert len(closed) == 9 and not closed.is_terminal.any()
    model.learn(8, reset_num_timesteps=False)
    assert len(model.replay_buffer.open[0]) == 17 and len(model.replay_buffer.episodes) == 1


def test_train_without_data_does_nothing(tiny_model, weights):
    model = tiny_model()
    model.set_logger(configure(None, []))
    before = weights(model.policy)
    model.train(5, 2)
    assert model._n_updates == 0 and weights(model.policy) == before


def test_set_env_ends_the_open_episodes(tiny_model):
    model = tiny_model(vec_env(2, 8)).learn(24)
    model.set_env(vec_env(2, 5))
    model.learn(24)
    # 8 and 4 steps in the old environments, 5 and 5 in the new.
    assert [len(episode) for episode in model.replay_buffer.episodes] == [9, 9, 5, 5, 6, 6, 6, 6]


def test_set_env_to_another_number_of_environments_is_refused(tiny_model):
    with pytest.raises(AssertionError, match=r"number of environments.* 1 != 2"):
        tiny_model(vec_env(2, 8)).set_env(vec_env(1, 8))


# -- seeds -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["lbs", None])
def test_equal_seeds_give_equal_weights(tiny_model, weights, method):
    def learn(seed):
        env = vec_env(2, 6, 9)
        return weights(tiny_model(env, seed=seed, intrinsic_reward=method, planner="dyna_mpc").learn(40).policy)

    first = learn(3)
    np.random.default_rng().random()
    assert first == learn(3)
    assert first != learn(4)


# -- saving ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("as_file", [True, False])
@pytest.mark.parametrize("method", ["lbs", None])
def test_save_and_load(tiny_model, weights, tmp_path, method, as_file):
    model = tiny_model(vec_env(2, 8), intrinsic_reward=method, planner="dyna_mpc", learning_rate=LinearSchedule(1e-3, 0, 1))
    model.learn(40)
    target = io.BytesIO() if as_file else tmp_path / "model"
    model.save(target)
    if as_file:
        target.seek(0)
    loaded = DreamerV2.load(target, env=vec_env(2, 8), device="cpu")
    assert weights(loaded.policy) == weights(model.policy) and optimizer_bytes(loaded) == optimizer_bytes(model)
    for name in ("num_timesteps", "_n_updates", "phase", "phase_timesteps", "phase_updates", "phase_frames", "batch_length"):
        assert getattr(loaded, name) == getattr(model, name), name
    assert loaded.learner.updates == model.learner.updates > 0
    assert loaded.policy_kwargs == model.policy_kwargs and loaded.planner_kwargs == model.planner_kwargs
    observation = np.full((2, 16, 16, 3), 99, np.uint8)
    assert np.array_equal(*[m.predict(observation, deterministic=True)[0] for m in (model, loaded)])
    before = weights(loaded.policy)
    loaded.learn(40)
    assert loaded._n_updates > model._n_updates and weights(loaded.policy) != before
    assert all(th.isfinite(value).all() for value in loaded.policy.state_dict().values())


def test_load_without_an_environment_then_predict(tiny_model, tmp_path):
    model = tiny_model(CounterEnv(8, action_repeat=2, never_terminates=True), planner="dyna_mpc").learn(24)
    model.save(tmp_path / "model.zip")
    loaded = DreamerV2.load(tmp_path / "model.zip")
    observation = np.zeros((16, 16, 3), np.uint8)
    assert loaded.get_env() is None and loaded._planner_is_on() and loaded.phase_frames == 48
    assert np.array_equal(*[m.predict(observation, deterministic=True)[0] for m in (model, loaded)])
    loaded.set_env(CounterEnv(8, action_repeat=2))
    loaded.learn(24)


def test_load_into_another_number_of_environments(tiny_model, tmp_path):
    tiny_model(vec_env(3, 8)).learn(30).save(tmp_path / "model")
    loaded = DreamerV2.load(tmp_path / "model", env=vec_env(2, 8), device="cpu").learn(40)
    assert loaded.n_envs == 2 and len(loaded.replay_buffer.episodes) == 2 * 2


def test_save_in_the_middle_of_training(tiny_model, weights, tmp_path):
    class Saver(BaseCallback):
        def _on_step(self):
            if self.n_calls == 21:
                self.model.save(tmp_path / "middle")
                seen.append(weights(self.model.policy))
            return True

    seen: list[dict[str, bytes]] = []
    model = tiny_model(vec_env(1, 8)).learn(40, callback=Saver())
    loaded = DreamerV2.load(tmp_path / "middle", env=vec_env(1, 8), device="cpu")
    assert weights(loaded.policy) == seen[0] != weights(model.policy)
    assert loaded.phase_timesteps == 21
    loaded.learn(20, reset_num_timesteps=False)
    assert loaded.phase_timesteps == loaded.num_timesteps == 41


def test_saving_twice_gives_the_same_model(tiny_model, weights, tmp_path):
    model = tiny_model(vec_env(1, 8)).learn(24)
    model.save(tmp_path / "one")
    once = DreamerV2.load(tmp_path / "one", device="cpu")
    once.save(tmp_path / "two")
    twice = DreamerV2.load(tmp_path / "two", env=vec_env(1, 8), device="cpu")
    assert weights(twice.policy) == weights(model.policy) and optimizer_bytes(twice) == optimizer_bytes(model)


def test_load_with_keywords(tiny_model, tmp_path):
    tiny_model().save(tmp_path / "model")
    loaded = DreamerV2.load(tmp_path / "model", planner="mppi", batch_length=6, actor_learning_rate=0.5)
    assert loaded.planner == "mppi" and not loaded.policy.planner.config.use_value
    assert loaded.replay_buffer.batch_length == 6 and loaded._actor_lr_schedule(1) == 0.5


@pytest.mark.parametrize("name", ["horizon", "predict", "preset", "policy", "phase", "_init_setup_model"])
def test_load_refuses_unknown_keywords(tiny_model, tmp_path, name):
    tiny_model().save(tmp_path / "model")
    with pytest.raises(TypeError, match=name):
        DreamerV2.load(tmp_path / "model", **{name: 3})


def test_load_checks_its_keywords_values(tiny_model, tmp_path):
    tiny_model().save(tmp_path / "model")
    with pytest.raises(ValueError, match="batch_length"):
        DreamerV2.load(tmp_path / "model", batch_length=-3)


def test_load_a_pretraining_snapshot_without_its_intrinsic_reward(tiny_model, tmp_path):
    tiny_model(intrinsic_reward="lbs").save(tmp_path / "model")
    with pytest.raises(ValueError, match="intrinsic_reward"):
        DreamerV2.load(tmp_path / "model", intrinsic_reward=None)


def test_load_with_another_adam_eps(tiny_model, tmp_path):
    tiny_model(vec_env(1, 8)).learn(24).save(tmp_path / "model")
    loaded = DreamerV2.load(tmp_path / "model", adam_eps=0.5)
    assert loaded.learner.model_optimizer.adam.param_groups[0]["eps"] == 0.5


def test_replay_buffer_round_trip(tiny_model, tmp_path):
    model = tiny_model(vec_env(2, 8)).learn(30)
    model.save_replay_buffer(tmp_path / "replay")
    other = tiny_model(vec_env(2, 8))
    other.load_replay_buffer(tmp_path / "replay")
    # Two finished episodes in two streams, and the open ones, which are closed.
    assert [len(episode) for episode in other.replay_buffer.episodes] == [9, 9, 9, 9]
    other.learn(30)
    assert other._n_updates > 0


def test_a_replay_buffer_of_another_phase_is_refused(tiny_model, tmp_path):
    tiny_model(intrinsic_reward="lbs").learn(20).save_replay_buffer(tmp_path / "replay")
    model = tiny_model().learn(20)
    before = model.replay_buffer
    with pytest.raises(ValueError, match=r"'pretraining'.*'finetuning'"):
        model.load_replay_buffer(tmp_path / "replay")
    assert model.replay_buffer is before


@pytest.mark.parametrize("kwargs", [{"n": 2}, {"n": 1, "batch_length": 6}])
def test_a_replay_buffer_that_does_not_fit_is_refused_or_adapted(tiny_model, tmp_path, kwargs):
    tiny_model(vec_env(1, 8)).learn(20).save_replay_buffer(tmp_path / "replay")
    model = tiny_model(vec_env(kwargs.pop("n"), 8), **kwargs)
    try:
        model.load_replay_buffer(tmp_path / "replay")
    except ValueError:
        return
    assert model.replay_buffer.n_envs == model.n_envs and model.replay_buffer.batch_length == model.batch_length


# -- logging and callbacks -------------------------------------------------------------------------------------------------


def test_what_is_logged(tiny_model):
    model = tiny_model(CounterEnv(8, rewards=[1.0], action_repeat=2), intrinsic_reward="lbs")
    logged: dict[str, list[float]] = {}
    logger = configure(None, [])
    original = logger.record
    logger.record = lambda key, value, exclude=None: (logged.setdefault(key, []).append(value), original(key, value, exclude))
    model.set_logger(logger)
    model.learn(48, log_interval=1)
    expected = {"rollout/ep_rew_mean", "rollout/ep_len_mean", "time/fps", "time/total_timesteps", "time/phase_frames"}
    expected |= {f"train/{name}" for name in ("learning_rate", "n_updates", "model_grad_norm", "actor_loss", "critic_loss")}
    expected |= {"train/intrinsic_reward", "train/intrinsic_loss", "train/kl", "train/image_loss", "train/reward_loss"}
    assert expected <= set(logged)
    assert all(len(key) <= 36 for key in logged)
    # The task's return is reported also while it drives nothing.
    assert logged["rollout/ep_rew_mean"] == [8.0] * 6 and logged["time/phase_frames"][-1] == 96
    assert logged["time/phase"][0] == "pretraining" and all(np.isfinite(logged["train/actor_loss"]))


def test_tensorboard_progress_bar_and_callbacks(tiny_model, tmp_path):
    model = tiny_model(vec_env(2, 8), planner="dyna_mpc", tensorboard_log=str(tmp_path / "tb"), verbose=0)
    evaluation = EvalCallback(
        vec_env(1, 8), eval_freq=12, n_eval_episodes=2, best_model_save_path=str(tmp_path / "best"), verbose=0, warn=False
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # rich's progress bar is experimental
        callbacks = [evaluation, CheckpointCallback(10, str(tmp_path / "checkpoints"), save_replay_buffer=True)]
        model.learn(48, callback=callbacks, log_interval=1, progress_bar=True)
    assert list((tmp_path / "tb" / "DreamerV2_1").glob("events*"))
    names = {path.name for path in (tmp_path / "checkpoints").iterdir()}
    assert {"rl_model_20_steps.zip", "rl_model_40_steps.zip", "rl_model_replay_buffer_40_steps.pkl"} <= names
    assert evaluation.best_mean_reward > 0
    best = DreamerV2.load(tmp_path / "best" / "best_model.zip", env=vec_env(1, 8), device="cpu")
    assert best.phase_timesteps in (24, 48)


def test_a_callback_stops_learning(tiny_model):
    assert tiny_model().learn(100, callback=Stopper(13)).num_timesteps == 13


# -- hyperparameters -------------------------------------------------------------------------------------------------------


def test_the_papers_defaults():
    import inspect

    defaults = {name: p.default for name, p in inspect.signature(DreamerV2.__init__).parameters.items()}
    expected = {
        "learning_rate": 3e-4,
        "actor_learning_rate": 8e-5,
        "critic_learning_rate": 8e-5,
        "learning_starts": 2000,
        "planner_delay": 500,
        "train_freq": 5,
        "gradient_steps": 1,
        "batch_size": 50,
        "batch_length": 50,
        "imagination_horizon": 15,
        "buffer_size": 1_000_000,
        "gamma": 0.99,
        "gae_lambda": 0.95,
        "kl_balance": 0.8,
        "free_nats": 1.0,
        "target_update_interval": 100,
        "adam_eps": 1e-5,
        "max_grad_norm": 100.0,
        "weight_decay": 1e-6,
        "preset": "paper",
    }
    assert {name: defaults[name] for name in expected} == expected
    assert PRESETS["paper"] == {}


@pytest.mark.parametrize("preset", sorted(PRESETS))
@pytest.mark.parametrize("method", [*sorted(registered_intrinsic_rewards()), None])
def test_entropy_bonus_of_every_preset_and_method(preset, method):
    """A method's own bonus survives every preset; fine-tuning, and methods without one, take the preset's; a user's wins."""
    small = {"policy_kwargs": PRESETS["tiny"]["policy_kwargs"], "batch_size": 2, "batch_length": 4, "buffer_size": 100}
    proposed = PRESETS[preset].get("ent_coef")

    def bonus(model):
        return model.learner.config.ent_coef

    if method is not None:
        model = DreamerV2("CnnPolicy", CounterEnv(8), preset=preset, intrinsic_reward=method, **small)
        own = get_intrinsic_reward(method).ent_coef
        assert bonus(model) == (own or proposed or 0.0)
        model.fine_tune()
    else:
        model = DreamerV2("CnnPolicy", CounterEnv(8), preset=preset, **small)
    assert bonus(model) == (1e-4 if proposed is None else proposed)
    file = io.BytesIO()
    model.save(file)
    file.seek(0)
    assert bonus(DreamerV2.load(file)) == bonus(model)
    chosen = DreamerV2("CnnPolicy", CounterEnv(8), preset=preset, intrinsic_reward=method, ent_coef=0.3, **small)
    assert bonus(chosen) == 0.3


def test_without_a_critic_in_the_plan_neither_actor_nor_critic_learn(tiny_model, weights):
    """As the authors' MPPI; pre-training learns both, and so does Dyna-MPC."""
    for planner, kwargs, learns in (
        ("mppi", {}, False), ("dyna_mpc", {"use_value": False}, False), ("dyna_mpc", {}, True), (None, {}, True),
    ):  # fmt: skip
        model = tiny_model(planner=planner, planner_kwargs=kwargs, intrinsic_reward="lbs")
        for exploring in (True, False):
            agent = model.policy.agent
            parts = ("world_model", "actor", "critic", "slow_critic")
            before = {name: weights(getattr(agent, name)) for name in parts}
            model.learn(40)
            changed = {name for name in parts if weights(getattr(agent, name)) != before[name]}
            assert changed == (set(parts) if learns or exploring else {"world_model"}) and model.phase_updates > 0
            if exploring:
                model.fine_tune()
        assert model._planner_is_on() == (planner is not None)


@pytest.mark.parametrize("flows", [True, False])
@pytest.mark.parametrize("method", [None, "lbs", "aps"])
def test_the_reward_heads_gradient_in_fine_tuning_is_an_option(tiny_model, method, flows):
    model = tiny_model(intrinsic_reward=method, reward_trains_model=flows)
    if method is not None:
        assert not model.learner.config.reward_trains_model
        model.fine_tune()
    assert model.learner.config.reward_trains_model == flows


@pytest.mark.parametrize("warmup", ["uniform", "saturated"])
def test_random_warm_up(tiny_model, warmup):
    """Saturated: uniform in ±A, replayed as drawn, clipped for the environment."""
    env = CounterEnv(8)
    model = tiny_model(env=env, warmup_actions=warmup, intrinsic_reward="lbs", learning_starts=400)
    model.learn(400)
    size = model.action_space.shape[0]
    drawn = np.concatenate([episode.action[1:] for episode in model.replay_buffer.episodes])
    bound = size if warmup == "saturated" else 1
    assert np.abs(drawn).max() <= bound and np.abs(drawn).max() > 0.95 * bound
    assert abs((np.abs(drawn) > 1).mean() - (1 - 1 / bound)) < 0.07
    low, high = model.action_space.low, model.action_space.high
    wanted = np.clip(drawn, -1, 1) * (high - low) / 2 + (high + low) / 2
    assert np.allclose(np.stack([action for episode in env.received for action in episode])[: len(wanted)], wanted, atol=1e-5)


@pytest.mark.parametrize(
    ("method", "ent_coef", "expected"), [("lbs", None, 0.0), (None, None, 1e-4), ("lbs", 0.2, 0.2), (None, 0, 0)]
)
def test_entropy_bonus_by_phase(tiny_model, method, ent_coef, expected):
    assert tiny_model(intrinsic_reward=method, ent_coef=ent_coef).learner.config.ent_coef == expected


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_replaces_defaults(preset):
    if preset == "paper":
        pytest.skip("its networks are large; its defaults are checked above")
    model = DreamerV2("CnnPolicy", CounterEnv(), preset=preset, device="cpu")
    for name, value in PRESETS[preset].items():
        # The preset proposes an entropy bonus: what counts is what the phase makes of it.
        found = model.learner.config.ent_coef if name == "ent_coef" else getattr(model, name)
        assert found == value or name == "train_freq", name
    assert model.train_freq.frequency == PRESETS[preset]["train_freq"]
    assert model.policy.agent.world_model.rssm.deter_size == PRESETS[preset]["policy_kwargs"]["deter_size"]
    assert model.gamma == 0.99  # not named by any preset


@pytest.mark.parametrize("preset", PRESETS)
def test_diayn_keeps_its_own_entropy_bonus_under_every_preset(preset, tiny_model, monkeypatch):
    proposed = {name: value for name, value in PRESETS[preset].items() if name == "ent_coef"}
    monkeypatch.setitem(PRESETS, preset, {**PRESETS["tiny"], **proposed})
    assert tiny_model(preset=preset, intrinsic_reward="diayn").learner.config.ent_coef == 0.1
    assert tiny_model(preset=preset, intrinsic_reward="lbs").learner.config.ent_coef == proposed.get("ent_coef", 0)
    assert tiny_model(preset=preset, intrinsic_reward="diayn", ent_coef=0.01).learner.config.ent_coef == 0.01


def test_what_is_written_out_wins_over_the_preset(tiny_model):
    model = tiny_model(
        batch_size=3, learning_starts=0, policy_kwargs={"deter_size": 5}, planner="dyna_mpc", planner_kwargs={"n_samples": 9}
    )
    assert model.batch_size == 3 and model.learning_starts == 0
    rssm, planner = model.policy.agent.world_model.rssm, model.policy.planner.config
    assert (rssm.deter_size, rssm.logits_shape) == (5, (3, 4))
    assert (planner.n_samples, planner.top_k, planner.horizon) == (9, 4, 3)
    assert PRESETS["tiny"]["policy_kwargs"]["deter_size"] == 8  # not changed for everyone
    positional = DreamerV2("CnnPolicy", CounterEnv(), 0.25, 0.5, preset="tiny", device="cpu")
    assert positional.learning_rate == 0.25 and positional.actor_learning_rate == 0.5


def test_make_vec_env_and_grey_images(tiny_model):
    model = tiny_model(make_vec_env(lambda: CounterEnv(8, size=40, channels=1), n_envs=2)).learn(24)
    assert model.observation_space.shape == (1, 40, 40) and model._n_updates > 0


def test_on_the_real_walker(tiny_model):
    """A few steps of rendering; two ``learn`` calls, since the reset between them ends an episode."""
    model = tiny_model("urlb/walker-stand-v0", planner="dyna_mpc", learning_starts=5)
    assert model.action_repeat == 2 and model.policy.agent.world_model.discount_logit is None
    model.learn(8).learn(8)
    assert model._n_updates > 0 and model.phase_frames == 32 and model._planner_is_on()
    assert model.replay_buffer.episodes[0].observation.shape == (9, 3, 64, 64)
