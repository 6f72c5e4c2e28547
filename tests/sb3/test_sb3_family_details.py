"""The family's smaller promises: what SB3's and sb3-contrib's test files ask beyond the main lines of each.

Names and order are those of their files; :mod:`test_sb3_family` has the main lines, and the list of deviations.
"""

from __future__ import annotations

import io
import warnings
from copy import deepcopy

import gymnasium
import numpy as np
import pytest
import torch as th
from fake_envs import CounterEnv
from family import VECTOR, family_model, same, short, weights
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback, EvalCallback, LogEveryNTimesteps
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.utils import ConstantSchedule, LinearSchedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_dreamer_urlb import DreamerV2

OBSERVATION = np.zeros(3, np.float32)


@pytest.fixture(scope="module")
def trained():
    """One model for all tests that only look."""
    return family_model(make_vec_env(short(), 2)).learn(48)


# -- run -------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("train_freq", [4, (4, "step"), (1, "episode")])
def test_train_freq(train_freq):
    model = family_model(short()(), train_freq=train_freq).learn(24)
    assert model._n_updates == {4: 4, (4, "step"): 4, (1, "episode"): 2}[train_freq]


@pytest.mark.parametrize("train_freq", ["4", (1, "steps"), "", 0, (0, "step")])
def test_train_freq_fail(train_freq):
    with pytest.raises((ValueError, AssertionError)):
        family_model(short()(), train_freq=train_freq).learn(8)


def test_episodes_count_for_one_environment_only():
    with pytest.raises(AssertionError, match="You must use only one env"):
        family_model(make_vec_env(short(), 2), train_freq=(1, "episode")).learn(8)


def test_as_many_updates_as_steps_of_several_environments():
    model = family_model(make_vec_env(short(), 2), train_freq=4, gradient_steps=-1).learn(32)
    # Every four steps of the pair; the first eight transitions are warm-up, the next end an episode with their last step only,
    # and updates come before that step's rows.
    assert model._n_updates == 2 * 8


def test_learning_goes_on_where_it_was():
    model = family_model(short()()).learn(20)
    updates = model._n_updates
    model.learn(12, reset_num_timesteps=False)
    assert model.num_timesteps == 32 and model._n_updates > updates
    model.learn(12)
    assert model.num_timesteps == 12


# -- train and evaluation mode ---------------------------------------------------------------------------------------------


def test_networks_are_in_training_mode_while_they_learn_only(trained, monkeypatch):
    modes = []
    model = family_model(short()())
    update = model.learner.update
    monkeypatch.setattr(model.learner, "update", lambda batch: (modes.append(model.policy.training), update(batch))[1])
    model.learn(24)
    model.predict(OBSERVATION)
    assert modes and all(modes) and not model.policy.training


# -- predict ---------------------------------------------------------------------------------------------------------------


class OwnBox(spaces.Box):
    """A space of the user's own making."""


class OwnDiscrete(spaces.Discrete):
    """Another."""


@pytest.mark.parametrize("action_space", [OwnBox(-1, 1, (2,), np.float32), OwnDiscrete(3)], ids=["box", "discrete"])
def test_subclassed_spaces(action_space, tmp_path):
    env = CounterEnv(6, observation_space=OwnBox(-1, 1, (3,), np.float32), action_space=action_space)
    model = family_model(env).learn(20)
    assert action_space.contains(model.predict(OBSERVATION)[0][()])
    model.save(tmp_path / "model")
    DreamerV2.load(tmp_path / "model", env=env)


def test_auto_wrap():
    model = family_model(gymnasium.make("Pendulum-v1"))
    assert isinstance(model.get_env(), DummyVecEnv) and model.get_env().env_is_wrapped(gymnasium.wrappers.TimeLimit) == [True]


# -- save and load ---------------------------------------------------------------------------------------------------------


def test_files_that_are_open(trained, tmp_path):
    buffer = io.BytesIO()
    trained.save(buffer)
    buffer.seek(0)
    with open(tmp_path / "model.zip", "wb") as file:
        trained.save(file)
    with open(tmp_path / "model.zip", "rb") as file:
        for loaded in (DreamerV2.load(buffer), DreamerV2.load(file), DreamerV2.load(str(tmp_path / "model.zip"))):
            assert same(weights(loaded), weights(trained))


def test_snapshots_are_whole(trained, tmp_path):
    for kwargs in ({"exclude": ["policy"]}, {"include": ["env"]}):
        with pytest.raises(ValueError, match="always whole"):
            trained.save(tmp_path / "model", **kwargs)


def test_system_information_is_printed(trained, tmp_path, capsys):
    trained.save(tmp_path / "model")
    DreamerV2.load(tmp_path / "model", print_system_info=True)
    printed = capsys.readouterr().out
    assert "CURRENT SYSTEM INFO" in printed and "SAVED MODEL SYSTEM INFO" in printed and "Gymnasium" in printed


def test_objects_given_to_load(trained, tmp_path):
    trained.save(tmp_path / "model")
    loaded = DreamerV2.load(tmp_path / "model", custom_objects={"learning_rate": 2e-5, "no_such_thing": 1})
    assert loaded.learning_rate == 2e-5 and not hasattr(loaded, "no_such_thing")
    with pytest.raises(TypeError, match="no_such_thing"):
        DreamerV2.load(tmp_path / "model", no_such_thing=1)


def test_parameters_that_do_not_fit(trained):
    parameters = trained.get_parameters()
    before = weights(trained)
    with pytest.raises(ValueError):
        trained.set_parameters({**parameters, "no_such_object": {}})
    wrong = deepcopy(parameters)
    wrong["policy"].popitem()
    with pytest.raises((RuntimeError, ValueError)):
        trained.set_parameters(wrong, exact_match=True)
    assert same(before, weights(trained))


@pytest.mark.parametrize("rate", [3e-4, LinearSchedule(3e-4, 0.0, 1.0), ConstantSchedule(3e-4)], ids=str)
def test_learning_rates_come_back(tmp_path, rate):
    family_model(short()(), learning_rate=rate).learn(20).save(tmp_path / "model")
    loaded = DreamerV2.load(tmp_path / "model", env=short()())
    assert loaded.lr_schedule(1.0) == pytest.approx(3e-4) and type(loaded.lr_schedule(1.0)) is float
    loaded.learn(8)


def test_replay_comes_back(trained, tmp_path):
    trained.save_replay_buffer(tmp_path / "replay.pkl")
    model = family_model(make_vec_env(short(), 2))
    model.load_replay_buffer(tmp_path / "replay.pkl", truncate_last_traj=False)
    pairs = list(zip(model.replay_buffer.episodes, trained.replay_buffer.episodes, strict=True))
    assert pairs and all(np.array_equal(a.columns[name], b.columns[name]) for a, b in pairs for name in b.columns)


def test_nothing_is_left_open(tmp_path):
    with warnings.catch_warnings():
        warnings.simplefilter("error", ResourceWarning)
        model = family_model(short()()).learn(8)
        model.save(tmp_path / "model")
        DreamerV2.load(tmp_path / "model")


def test_set_env():
    model = family_model(make_vec_env(short(), 2)).learn(16)
    other = make_vec_env(short(), 2)
    model.set_env(other, force_reset=False)
    other.reset()
    model.learn(16, reset_num_timesteps=False)
    assert model.get_env() is other and model.num_timesteps == 32
    with pytest.raises(ValueError, match="spaces do not match"):
        model.set_env(make_vec_env(short("CartPole-v1"), 2))


# -- spaces ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("observation_space", "action_space"),
    [
        (spaces.Discrete(4, start=-1), spaces.Discrete(3, start=2)),
        (spaces.MultiDiscrete([2, 3], start=[1, 0]), spaces.MultiDiscrete([[2], [3]])),
        (spaces.MultiBinary((2, 2)), spaces.Box(np.array([-2, 0]), np.array([-1, 5]), dtype=np.float32)),
        (spaces.Box(-100, 100, (2,), np.int64), spaces.Box(-1, 1, (1,), np.float64)),
        (spaces.Box(-np.inf, np.inf, (2,), np.float32), spaces.Box(-1, 1, (2, 1, 2), np.float32)),
    ],
    ids=["discrete with a start", "classes with a start, matrix", "binary matrix", "integers", "unbounded"],
)
def test_spaces(observation_space, action_space):
    env = CounterEnv(6, observation_space=observation_space, action_space=action_space)
    model = family_model(env).learn(20)
    assert model._n_updates > 0 and all(action_space.contains(action) for episode in env.received for action in episode)
    action, _ = model.predict(observation_space.sample())
    assert action.dtype == action_space.dtype and action_space.contains(action[()])


def test_matrices_of_classes_are_refused_as_observations():
    with pytest.raises(AssertionError, match="one dimension only"):
        family_model(CounterEnv(6, observation_space=spaces.MultiDiscrete([[2, 3], [3, 2]])))


def test_nested_dicts_are_refused():
    space = spaces.Dict({"outer": spaces.Dict({"inner": VECTOR})})
    with pytest.raises((NotImplementedError, ValueError), match=r"[Nn]ested|Observation"):
        family_model(CounterEnv(6, observation_space=space), "MultiInputPolicy")


# -- callbacks -------------------------------------------------------------------------------------------------------------


class Hooks(BaseCallback):
    """Counts what is called, and sees what SB3's callbacks see."""

    def __init__(self):
        super().__init__()
        self.called = []
        self.seen = set()

    def _on_training_start(self):
        self.called.append("training_start")

    def _on_rollout_start(self):
        self.called.append("rollout_start")

    def _on_step(self):
        self.seen |= set(self.locals)
        return True

    def _on_rollout_end(self):
        self.called.append("rollout_end")

    def _on_training_end(self):
        self.called.append("training_end")


def test_hooks_come_in_order_with_the_usual_locals():
    hooks = Hooks()
    family_model(short()(), train_freq=8).learn(16, hooks)
    assert hooks.called == ["training_start", *["rollout_start", "rollout_end"] * 2, "training_end"]
    assert {"self", "total_timesteps", "infos", "rewards", "dones", "new_obs", "replay_buffer"} <= hooks.seen


@pytest.mark.parametrize("n_envs", [1, 2])
def test_progress_bar(n_envs, capsys):
    family_model(make_vec_env(short(), n_envs)).learn(16, progress_bar=True)
    printed = "".join(capsys.readouterr())
    assert "16/16" in printed


def test_evaluations_are_logged_at_their_own_step(tmp_path):
    model = family_model(short()(), tensorboard_log=str(tmp_path))
    model.learn(24, EvalCallback(make_vec_env(short(), 1), eval_freq=9, n_eval_episodes=1, verbose=0, warn=False))
    events = EventAccumulator(str(tmp_path / "DreamerV2_1"))
    events.Reload()
    assert [event.step for event in events.Scalars("eval/mean_reward")] == [9, 18]


def test_evaluating_without_the_trainings_normalisation_is_a_friendly_error():
    model = family_model(VecNormalize(make_vec_env(short(), 1)))
    with pytest.raises(AssertionError, match="normalization"):
        model.learn(8, EvalCallback(make_vec_env(short(), 1), eval_freq=2, n_eval_episodes=1, warn=False))


def test_checkpoints_with_statistics(tmp_path):
    model = family_model(VecNormalize(make_vec_env(short(), 1)))
    model.learn(8, CheckpointCallback(8, str(tmp_path), save_replay_buffer=True, save_vecnormalize=True))
    assert {path.name for path in tmp_path.iterdir()} == {
        "rl_model_8_steps.zip", "rl_model_replay_buffer_8_steps.pkl", "rl_model_vecnormalize_8_steps.pkl",
    }  # fmt: skip
    model.load_replay_buffer(tmp_path / "rl_model_replay_buffer_8_steps.pkl")


# -- logger and TensorBoard ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["a[b]", "run 1.5"])
def test_names_of_runs_that_look_like_patterns(tmp_path, name):
    for _ in range(2):
        family_model(short()(), tensorboard_log=str(tmp_path)).learn(1, tb_log_name=name)
    assert {path.name for path in tmp_path.iterdir()} == {f"{name}_1", f"{name}_2"}


def test_a_logger_of_ones_own_is_kept(tmp_path):
    model = family_model(short()(), tensorboard_log=str(tmp_path / "unused"))
    model.set_logger(configure(str(tmp_path / "own"), ["csv"]))
    model.learn(16, log_interval=1)
    assert not (tmp_path / "unused").exists() and (tmp_path / "own" / "progress.csv").stat().st_size > 0


def test_log_interval(tmp_path):
    def lines(callback=None, **kwargs):
        model = family_model(short()())
        model.set_logger(configure(str(tmp_path), ["csv"]))
        model.learn(48, callback, **kwargs)
        return len((tmp_path / "progress.csv").read_text().splitlines()) - 1

    assert (lines(log_interval=1), lines(log_interval=3)) == (6, 2)
    assert lines(LogEveryNTimesteps(n_steps=12), log_interval=None) == 4


def test_frames_a_second_of_a_second_run(tmp_path):
    """SB3 counts from where the call began."""
    model = family_model(short()())
    for reset in (True, False):
        model.set_logger(configure(None, []))
        model.learn(16, reset_num_timesteps=reset)
        model.dump_logs()
    assert model._num_timesteps_at_start == 16


# -- vectorised environments -----------------------------------------------------------------------------------------------


def test_vec_monitor():
    env = VecMonitor(DummyVecEnv([short(), short()]))
    model = family_model(env).learn(32)
    assert [info["l"] for info in model.ep_info_buffer] == [8] * 4
    assert evaluate_policy(model, env, n_eval_episodes=2, return_episode_rewards=True)[1] == [8, 8]


def test_environments_whose_episodes_end_at_different_times():
    env = DummyVecEnv([lambda length=length: CounterEnv(length, observation_space=VECTOR) for length in (5, 7, 11)])
    model = family_model(env).learn(90)
    assert {len(episode) for episode in model.replay_buffer.episodes} == {6, 8, 12}


# -- recurrent -------------------------------------------------------------------------------------------------------------


def test_state_without_episode_start_goes_on(trained):
    observation = np.zeros((2, 3), np.float32)
    _, state = trained.predict(observation, deterministic=True)
    going_on = trained.predict(observation, state, np.zeros(2, bool), deterministic=True)
    silent = trained.predict(observation, state, None, deterministic=True)
    assert np.array_equal(going_on[0], silent[0]) and all(map(np.array_equal, going_on[1], silent[1]))
    beginning = trained.predict(observation, None, np.zeros(2, bool), deterministic=True)
    assert all(map(np.array_equal, beginning[1], state))


def test_state_of_another_number_of_environments_is_refused(trained):
    _, state = trained.predict(np.zeros((2, 3), np.float32))
    with pytest.raises(ValueError, match="environments"):
        trained.predict(np.zeros((3, 3), np.float32), state)
    with pytest.raises(ValueError, match="episode_start"):
        trained.predict(np.zeros((2, 3), np.float32), state, np.zeros(3, bool))


def test_predict_leaves_its_arguments_and_the_model_alone(trained):
    observation, start = np.zeros((2, 3), np.float32), np.ones(2, bool)
    _, state = trained.predict(observation)
    copies, before = deepcopy((observation, state, start)), weights(trained)
    generator = th.get_rng_state()
    trained.predict(observation, state, start, deterministic=True)
    assert same(before, weights(trained)) and th.equal(generator, th.get_rng_state())
    assert np.array_equal(copies[0], observation) and np.array_equal(copies[2], start)
    assert all(map(np.array_equal, copies[1], state))


def test_an_evaluation_callback_of_several_environments_while_training():
    train, test = make_vec_env(short(), 2), make_vec_env(short(), 3)
    evaluation = EvalCallback(test, eval_freq=6, n_eval_episodes=4, verbose=0, warn=False)
    family_model(train).learn(32, evaluation)
    assert np.isfinite(evaluation.last_mean_reward)


def test_policies_from_a_class():
    model = DreamerV2(DreamerV2.policy_aliases["MlpPolicy"], short()(), preset="tiny", learning_starts=8, device="cpu").learn(
        12
    )
    with pytest.raises(ValueError, match="Unknown policy 'MlpLstmPolicy'; known are"):
        DreamerV2("MlpLstmPolicy", short()())
    assert model.predict(OBSERVATION)[0].shape == (1,)
