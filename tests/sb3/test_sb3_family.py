"""What Stable-Baselines3 and sb3-contrib promise of each of their algorithms, asked of DreamerV2 and DrQv2.

Their test files take an algorithm by adding it to a list; here are the same promises in our own words, in the order of
their files: run, predict, deterministic, save and load, spaces, callbacks, logger and TensorBoard, dict observations,
vectorised environments, VecNormalize, CNN, recurrent.

Where DreamerV2 deviates, and why:

- It learns from whole sequences of finished episodes: a run shorter than its first episode makes no update, and
  ``batch_length`` must fit into an episode. A transition buffer would have no such bound.
- ``replay_buffer_class`` must be a SequenceReplayBuffer; HER, n-step returns and ``optimize_memory_usage`` concern
  transition buffers.
- No gSDE, no ``features_extractor_class``, ``share_features_extractor``, ``activation_fn``, ``optimizer_class`` or
  ``n_critics``: the world model is the extractor, and the paper fixes the rest. Unknown ``policy_kwargs`` are refused.
- ``policy_kwargs["net_arch"]`` is one list for all heads, actor, critic and the encoders of vectors, not a dictionary.
- ``predict`` always returns a state, as recurrent agents do; the first call makes it. ``deterministic=False`` draws from
  torch's global generator, as everywhere in SB3.
- Float images must have their channels first (as in SB3, which transposes uint8 images only) and finite bounds.
- MultiBinary actions are refused, with SB3's AssertionError.
- A snapshot is always whole: ``save`` takes neither ``exclude`` nor ``include``; it holds no replay, as in SB3.
- ``load`` refuses keywords that are no constructor arguments; SB3 sets any as an attribute.
- ``num_timesteps`` may overshoot by less than ``train_freq`` steps, as in SB3's other off-policy algorithms.
- A Dict with one vector is not the same network as that vector alone: its encoder stands behind a name.
- The identity environments that SB3 learns as a check are not learnt here: the preset that does takes minutes. What is
  learnt is checked by ``make test-slow`` and docs/results.md.
- ``learning_starts`` counts steps of the phase, not of the call: a second ``learn`` does not warm up again.
- Dict observations need ``MultiInputPolicy`` and images ``CnnPolicy`` or ``MlpPolicy`` (flattened), as in SB3.

DrQv2 shares all of that but for sequences and world model: it takes Box actions only, no Dict observations, and any episode.
"""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from fake_envs import CounterEnv
from family import VECTOR, family_model, same, short, weights
from gymnasium import spaces
from stable_baselines3.common.callbacks import (
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    EveryNTimesteps,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.envs import FakeImageEnv, SimpleMultiObsEnv
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecFrameStack,
    VecNormalize,
    VecTransposeImage,
)

from sb3_dreamer_urlb import DreamerV2, DrQv2

ALGORITHMS = [DreamerV2, DrQv2]
both = pytest.mark.parametrize("algorithm", ALGORITHMS)
#: environments that each of them can act in
EVERYWHERE = [("Pendulum-v1", DreamerV2), ("CartPole-v1", DreamerV2), ("Pendulum-v1", DrQv2)]
everywhere = pytest.mark.parametrize(("env_id", "algorithm"), EVERYWHERE)
#: an optimiser that follows ``learning_rate``
OPTIMIZER = {DreamerV2: "model_optimizer", DrQv2: "critic_optimizer"}


@pytest.fixture(scope="module", params=ALGORITHMS)
def trained(request):
    """One model of each for all tests that only look."""
    return family_model(make_vec_env(short(), 2), algorithm=request.param).learn(48)


@pytest.fixture(scope="module")
def recurrent():
    """A trained model that remembers whole episodes."""
    return family_model(make_vec_env(short(), 2)).learn(48)


def learning_rate(model):
    return model.learner.optimizers()[OPTIMIZER[type(model)]].learning_rate


# -- run -------------------------------------------------------------------------------------------------------------------


@everywhere
@pytest.mark.parametrize("kwargs", [{}, {"train_freq": (1, "episode"), "gradient_steps": -1}, {"gamma": 0.9, "verbose": 1}])
def test_run(env_id, algorithm, kwargs):
    model = family_model(short(env_id)(), algorithm=algorithm, **kwargs)
    before = weights(model)
    model.learn(24)
    assert model.num_timesteps == 24 and model._n_updates > 0 and not same(before, weights(model))


@both
def test_a_registered_name_as_environment(capsys, algorithm):
    model = family_model("Pendulum-v1", algorithm=algorithm, verbose=1).learn(12)
    assert model.env.num_envs == 1 and "Wrapping the env" in capsys.readouterr().out


@both
@pytest.mark.parametrize("noise", [NormalActionNoise, OrnsteinUhlenbeckActionNoise])
def test_action_noise(noise, algorithm):
    one = noise(np.zeros(1), 0.5 * np.ones(1))
    noises = VectorizedActionNoise(one, 2)
    model = family_model(make_vec_env(short(), 2), algorithm=algorithm, action_noise=noises).learn(16)
    assert np.abs(model.replay_buffer.episodes[0].action).max() <= 1


@both
def test_train_may_be_called_with_hardly_any_data(algorithm):
    model = family_model(short()(), algorithm=algorithm).learn(3)
    model.train(gradient_steps=1, batch_size=2)
    # DreamerV2 learns from sequences of finished episodes, as in the paper; DrQv2 from the rows that there are, as in SB3.
    assert model._n_updates == (algorithm is DrQv2)


@both
def test_learning_rate_schedule(algorithm):
    model = family_model(short()(), algorithm=algorithm, learning_rate=lambda left: 1e-3 * left)
    model.learn(24)
    assert 0 <= learning_rate(model) < 1e-3


@pytest.mark.parametrize(
    ("kwargs", "algorithm"),
    [
        *(({name: True}, algorithm) for name in ("use_sde", "optimize_memory_usage") for algorithm in ALGORITHMS),
        ({"n_steps": 3}, DreamerV2),
        ({"planner": "dyna_mpc"}, DrQv2),
    ],
)
def test_what_does_not_apply_is_refused(kwargs, algorithm):
    with pytest.raises(TypeError):
        family_model(short()(), algorithm=algorithm, **kwargs)


@both
@pytest.mark.parametrize("name", ["features_extractor_class", "activation_fn", "optimizer_class", "n_critics"])
def test_policy_kwargs_that_do_not_apply_are_refused(name, algorithm):
    with pytest.raises(ValueError, match=name):
        family_model(short()(), algorithm=algorithm, policy_kwargs={name: None})


# -- predict ---------------------------------------------------------------------------------------------------------------


def test_predict(trained):
    env = trained.get_env()
    observation = env.reset()
    actions, state = trained.predict(observation, deterministic=True)
    assert actions.shape == (2, 1) and isinstance(state, tuple)
    action, _ = trained.predict(observation[0], deterministic=True)
    assert env.action_space.contains(action) and np.allclose(action, actions[0], atol=1e-5)
    by_policy, _ = trained.policy.predict(observation, deterministic=True)
    assert np.array_equal(by_policy, actions)
    env.step(trained.predict(observation, deterministic=False)[0])


@pytest.mark.parametrize("observation", [(np.zeros(3), {}), {"a": np.zeros(3)}, np.zeros(4), np.zeros((2, 2, 3))])
def test_predict_refuses_what_is_no_observation(trained, observation):
    with pytest.raises((ValueError, AssertionError)):
        trained.predict(observation)


def test_predicted_classes_have_the_spaces_dtype():
    model = family_model(short("CartPole-v1")())
    action, _ = model.predict(np.zeros(4, np.float32))
    assert model.action_space.contains(action[()]) and action.dtype == model.action_space.dtype
    assert model.predict(np.zeros((3, 4), np.float32))[0].shape == (3,)


# -- deterministic ---------------------------------------------------------------------------------------------------------


@everywhere
def test_equal_seeds_give_equal_runs(env_id, algorithm):
    runs = []
    for seed in (3, 3, 4):
        model = family_model(make_vec_env(short(env_id), 2, seed=seed), algorithm=algorithm, seed=seed).learn(32)
        observation = np.zeros(model.observation_space.shape, np.float32)
        runs.append((weights(model), [info["r"] for info in model.ep_info_buffer], model.predict(observation)[0]))
    assert same(runs[0][0], runs[1][0]) and not same(runs[0][0], runs[2][0])
    assert runs[0][1] == runs[1][1] and np.array_equal(runs[0][2], runs[1][2])


# -- save and load ---------------------------------------------------------------------------------------------------------


@everywhere
def test_save_and_load(tmp_path, env_id, algorithm):
    env = make_vec_env(short(env_id), 1)
    model = family_model(env, algorithm=algorithm).learn(24)
    observation = np.stack([env.observation_space.sample() for _ in range(4)]).clip(-1, 1)
    expected, _ = model.predict(observation, deterministic=True)
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "replay")
    model.policy.save(tmp_path / "policy.pkl")
    loaded = algorithm.load(tmp_path / "model", env=make_vec_env(short(env_id), 1), device="cpu")
    assert same(weights(model), weights(loaded)) and loaded.num_timesteps == 24
    assert np.array_equal(loaded.predict(observation, deterministic=True)[0], expected)
    loaded.load_replay_buffer(tmp_path / "replay")
    assert loaded.replay_buffer.size() == model.replay_buffer.size()
    loaded.learn(16, reset_num_timesteps=False)
    assert loaded.num_timesteps == 40 and not same(weights(model), weights(loaded))
    policy = type(model.policy).load(tmp_path / "policy.pkl", device="cpu")
    assert np.array_equal(policy.predict(observation, deterministic=True)[0], expected)


def test_load_without_environment_and_with_other_arguments(trained, tmp_path):
    trained.save(tmp_path / "model.zip")
    loaded = type(trained).load(tmp_path / "model.zip", device="cpu", learning_rate=5e-4, gamma=0.9)
    assert loaded.env is None and loaded.gamma == 0.9 and learning_rate(loaded) == 5e-4
    loaded.set_env(make_vec_env(short(), 2))
    loaded.learn(16)
    with pytest.raises(AssertionError):  # another number of environments
        loaded.set_env(make_vec_env(short(), 1))
    with pytest.raises(ValueError, match="spaces do not match"):
        type(trained).load(tmp_path / "model.zip", env=short("CartPole-v1")(), device="cpu")


def test_parameters_go_out_and_in(trained):
    model = family_model(make_vec_env(short(), 2), algorithm=type(trained), seed=1)
    parameters = trained.get_parameters()
    assert not same(weights(model), weights(trained))
    model.set_parameters(parameters, exact_match=False)
    assert same(weights(model), weights(trained))
    with pytest.raises(ValueError):
        model.set_parameters({"policy": parameters["policy"]}, exact_match=True)


# -- spaces ----------------------------------------------------------------------------------------------------------------

OBSERVATIONS = [
    spaces.Discrete(4),
    spaces.MultiDiscrete([2, 3]),
    spaces.MultiBinary(3),
    spaces.Box(-1, 1, (2, 2), np.float64),
]
ACTIONS = [
    spaces.Discrete(3),
    spaces.MultiDiscrete([2, 3]),
    spaces.Box(-1, 1, (2,), np.float64),
    spaces.Box(0, 3, (2, 2), np.float32),
]


@both
@pytest.mark.parametrize("space", OBSERVATIONS, ids=str)
def test_observation_spaces(space, algorithm):
    model = family_model(CounterEnv(6, observation_space=space), algorithm=algorithm).learn(20)
    assert model._n_updates > 0 and np.isfinite(evaluate_policy(model, model.get_env(), n_eval_episodes=1, warn=False)[0])


@pytest.mark.parametrize(
    ("space", "algorithm"), [*((space, DreamerV2) for space in ACTIONS), *((space, DrQv2) for space in ACTIONS[2:])]
)
def test_action_spaces(space, algorithm):
    env = CounterEnv(6, observation_space=VECTOR, action_space=space)
    model = family_model(env, algorithm=algorithm).learn(20)
    assert model._n_updates > 0 and all(space.contains(action) for episode in env.received for action in episode)
    assert space.contains(model.predict(VECTOR.sample())[0][()])


REFUSED = [spaces.MultiBinary(3), spaces.Box(-np.inf, np.inf, (2,))]


@pytest.mark.parametrize(
    ("space", "algorithm"),
    [*((space, DreamerV2) for space in REFUSED), *((space, DrQv2) for space in [*REFUSED, *ACTIONS[:2]])],
)
def test_other_action_spaces_raise_an_assertion_error(space, algorithm):
    with pytest.raises(AssertionError):
        family_model(CounterEnv(6, observation_space=VECTOR, action_space=space), algorithm=algorithm)


# -- callbacks -------------------------------------------------------------------------------------------------------------


@both
def test_callbacks(tmp_path, algorithm):
    stop = StopTrainingOnRewardThreshold(reward_threshold=1e9)
    evaluation = EvalCallback(
        make_vec_env(short(), 1),
        callback_on_new_best=stop,
        callback_after_eval=StopTrainingOnNoModelImprovement(max_no_improvement_evals=50),
        best_model_save_path=str(tmp_path),
        log_path=str(tmp_path),
        eval_freq=12,
        n_eval_episodes=1,
        warn=False,
    )
    checkpoint = CheckpointCallback(8, str(tmp_path), save_replay_buffer=True)
    every = EveryNTimesteps(n_steps=16, callback=CheckpointCallback(1, str(tmp_path), name_prefix="event"))
    model = family_model(short()(), algorithm=algorithm).learn(
        24, CallbackList([checkpoint, evaluation, every]), progress_bar=True
    )
    assert evaluation.n_calls == 24 and np.isfinite(evaluation.last_mean_reward)
    written = {path.name for path in tmp_path.iterdir()}
    assert {"best_model.zip", "evaluations.npz", "rl_model_8_steps.zip", "event_16_steps.zip"} <= written
    assert "rl_model_replay_buffer_24_steps.pkl" in written
    model.learn(8, callback=[], reset_num_timesteps=False)
    model.learn(8, callback=lambda local, _global: "self" in local)
    assert algorithm.load(tmp_path / "best_model", device="cpu").predict(np.zeros(3, np.float32))[0].shape == (1,)


@both
def test_a_callback_can_stop_it(algorithm):
    model = family_model(make_vec_env(short(), 2), algorithm=algorithm).learn(100, StopTrainingOnMaxEpisodes(max_episodes=2))
    assert model.num_timesteps == 4 * 8  # two episodes an environment
    assert family_model(short()(), algorithm=algorithm).learn(50, callback=lambda *_: False).num_timesteps == 1


@both
def test_evaluation_while_learning_changes_nothing(algorithm):
    def learnt(callback):
        return weights(family_model(make_vec_env(short(), 1, seed=0), algorithm=algorithm).learn(24, callback))

    evaluation = EvalCallback(make_vec_env(short(), 1, seed=7), eval_freq=8, n_eval_episodes=1, verbose=0, warn=False)
    assert same(learnt(None), learnt(evaluation))


# -- logger and TensorBoard ------------------------------------------------------------------------------------------------


@both
def test_tensorboard(tmp_path, algorithm):
    model = family_model(short()(), algorithm=algorithm, tensorboard_log=str(tmp_path))
    model.learn(20)
    model.learn(20, tb_log_name="second")
    model.learn(20, reset_num_timesteps=False, tb_log_name="second")
    assert {path.name for path in tmp_path.iterdir()} == {f"{algorithm.__name__}_1", "second_1"}
    assert all(list(folder.glob("events.*")) for folder in tmp_path.iterdir())


@both
def test_logger(tmp_path, capsys, algorithm):
    model = family_model(make_vec_env(short(), 2), algorithm=algorithm, stats_window_size=3)
    model.set_logger(configure(str(tmp_path), ["csv", "json", "stdout"]))
    model.learn(64, log_interval=2)
    header = (tmp_path / "progress.csv").read_text().splitlines()[0].split(",")
    expected = {"rollout/ep_rew_mean", "rollout/ep_len_mean", "time/fps", "time/total_timesteps", "train/critic_loss"}
    assert expected <= set(header) and len({key[:36] for key in header}) == len(header)
    assert len(model.ep_info_buffer) == 3 and "ep_rew_mean" in capsys.readouterr().out


# -- dict observations -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("channel_last", [True, False])
@pytest.mark.parametrize("discrete", [True, False])
def test_dict_observations(tmp_path, channel_last, discrete):
    def make():
        return gymnasium.wrappers.TimeLimit(SimpleMultiObsEnv(discrete_actions=discrete, channel_last=channel_last), 6)

    env = make_vec_env(make, 2)
    model = family_model(env, "MultiInputPolicy").learn(40)
    assert model._n_updates > 0
    evaluate_policy(model, env, n_eval_episodes=2, warn=False)
    model.save(tmp_path / "model")
    observation, _ = make().reset()
    expected, _ = model.predict(observation, deterministic=True)
    assert np.array_equal(DreamerV2.load(tmp_path / "model").predict(observation, deterministic=True)[0], expected)


@both
@pytest.mark.parametrize("policy", ["MlpPolicy", "CnnPolicy"])
def test_a_dict_needs_its_policy(policy, algorithm):
    with pytest.raises(ValueError):
        family_model(SimpleMultiObsEnv(discrete_actions=False), policy, algorithm)


def test_dicts_stacked_and_normalised():
    space = spaces.Dict({"a": VECTOR, "image": spaces.Box(0, 255, (16, 16, 1), np.uint8)})
    env = DummyVecEnv([lambda: CounterEnv(6, observation_space=space)] * 2)
    env = VecNormalize(VecFrameStack(env, 2), norm_obs_keys=["a"])
    model = family_model(env, "MultiInputPolicy").learn(24)
    assert model._n_updates > 0 and model.policy.observation_space["image"].shape == (2, 16, 16)


# -- vectorised environments -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("env_id", "algorithm"), EVERYWHERE[1:])
@pytest.mark.parametrize(("vec_env", "kwargs"), [(DummyVecEnv, {}), (SubprocVecEnv, {"start_method": "fork"})])
def test_vectorised_environments(vec_env, kwargs, env_id, algorithm):
    env = make_vec_env(short(env_id), 3, vec_env_cls=vec_env, vec_env_kwargs=kwargs)
    try:
        model = family_model(env, algorithm=algorithm).learn(36)
        assert model.num_timesteps == 36 and model._n_updates > 0
        assert model.predict(env.reset())[0].shape == (3, *env.action_space.shape)
    finally:
        env.close()


def test_a_snapshot_goes_on_with_another_number_of_environments(trained, tmp_path):
    trained.save(tmp_path / "model")
    env = make_vec_env(short(), 3)
    model = type(trained).load(tmp_path / "model", env=env, device="cpu")
    assert model.learn(30).n_envs == 3


# -- VecNormalize ----------------------------------------------------------------------------------------------------------


@both
def test_vec_normalize(tmp_path, algorithm):
    env = VecNormalize(make_vec_env(short(), 2))
    model = family_model(env, algorithm=algorithm).learn(40)
    assert model.get_vec_normalize_env() is env and model._n_updates > 0
    assert (
        min(model.replay_buffer.episodes[0].reward) < -1e-3 and np.abs(model.replay_buffer.episodes[0].observation).max() <= 8
    )
    test = VecNormalize(make_vec_env(short(), 1), training=False, norm_reward=False)
    EvalCallback(test, eval_freq=1, n_eval_episodes=1, verbose=0, warn=False).init_callback(model)
    model.learn(8, EvalCallback(test, eval_freq=2, n_eval_episodes=1, verbose=0, warn=False))
    assert np.array_equal(test.obs_rms.mean, env.obs_rms.mean)


# -- CNN -------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("discrete", "algorithm"), [(True, DreamerV2), (False, DreamerV2), (False, DrQv2)])
@pytest.mark.parametrize(("size", "channels", "first"), [(40, 1, False), (36, 3, False), (36, 1, True)])
def test_cnn(tmp_path, size, channels, first, discrete, algorithm):
    def make():
        image = FakeImageEnv(6, size, size, channels, discrete, first)
        return gymnasium.wrappers.TimeLimit(image, 6)

    env = make()
    model = family_model(env, "CnnPolicy", algorithm).learn(20)
    assert isinstance(model.env, VecTransposeImage) != first and model._n_updates > 0
    observation, _ = env.reset()
    expected, _ = model.predict(observation, deterministic=True)
    model.save(tmp_path / "model")
    loaded = algorithm.load(tmp_path / "model", device="cpu")
    assert np.array_equal(loaded.predict(observation, deterministic=True)[0], expected)
    if not first:  # the other layout is recognised
        assert np.array_equal(loaded.predict(observation.transpose(2, 0, 1), deterministic=True)[0], expected)


@pytest.mark.parametrize(("algorithm", "kwargs"), [(DreamerV2, {}), (DrQv2, {"frame_stack": 1}), (DrQv2, {"frame_stack": 2})])
def test_stacked_frames(algorithm, kwargs):
    image = FakeImageEnv(6, 36, 36, discrete=algorithm is DreamerV2)
    env = VecFrameStack(make_vec_env(lambda: gymnasium.wrappers.TimeLimit(image, 6), 1), 4)
    model = family_model(env, "CnnPolicy", algorithm, **kwargs).learn(24)
    assert model.policy.observation_space.shape == (4, 36, 36) and model._n_updates > 0


# -- recurrent -------------------------------------------------------------------------------------------------------------


def test_state_and_episode_start(recurrent):
    observation, rng = np.zeros((2, 3), np.float32), np.random.default_rng(0)
    _, fresh = recurrent.predict(observation, deterministic=True)
    _, state = recurrent.predict(rng.normal(size=(2, 3)).astype(np.float32), deterministic=True)
    _, reset = recurrent.predict(observation, state, np.ones(2, bool), deterministic=True)
    assert all(np.allclose(a, b, atol=1e-6) for a, b in zip(reset[:2], fresh[:2], strict=True))
    _, kept = recurrent.predict(observation, state, np.zeros(2, bool), deterministic=True)
    assert not np.allclose(kept[1], fresh[1])
    _, mixed = recurrent.predict(observation, state, np.array([True, False]), deterministic=True)
    assert np.allclose(mixed[1][0], fresh[1][0], atol=1e-6) and np.allclose(mixed[1][1], kept[1][1], atol=1e-6)


def test_evaluate_policy_threads_the_state(trained):
    env = make_vec_env(short(), 2, seed=0)
    returns, lengths = evaluate_policy(trained, env, n_eval_episodes=4, return_episode_rewards=True)
    assert lengths == [8] * 4 and np.isfinite(returns).all()


def test_it_remembers_what_it_no_longer_sees(recurrent):
    """A hint in the first observation only: the features of the last step still tell which it was."""
    last = []
    for hint in (-1, 1):
        state, start = None, np.ones(1, bool)
        for t in range(4):
            seen = np.full((1, 3), 1000 * hint if t == 0 else 0, np.float32)
            _, state = recurrent.predict(seen, state, start, deterministic=True)
            start = np.zeros(1, bool)
        last.append(state[1])
    assert not np.allclose(*last)
