"""Bad input raises one clear error, which names the value and what was expected, before anything is built."""

from __future__ import annotations

import math

import gymnasium
import numpy as np
import pytest
import torch as th
from fake_envs import CounterEnv
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from snapshot_files import change_data
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_dreamer_urlb import (
    DreamerV2,
    PhaseSwitchCallback,
    SnapshotCallback,
    SnapshotError,
    dreamer_v2,
    register_intrinsic_reward,
)
from sb3_dreamer_urlb.dreamer_v2 import policies
from sb3_dreamer_urlb.dreamer_v2.arguments import INTEGERS, NUMBERS, SHORT_EPISODES
from sb3_dreamer_urlb.evaluation.scores import normalized_score
from sb3_dreamer_urlb.intrinsic import LBS
from sb3_dreamer_urlb.spaces.errors import UnsupportedSpaceError


@pytest.fixture
def refused(tiny_model, monkeypatch):
    """Assert that a constructor call raises, and builds no network."""

    def build(*_, **__):
        raise AssertionError("a network was built before the arguments were checked")

    def check(message, env=None, error=ValueError, **kwargs):
        with monkeypatch.context() as patch:
            patch.setattr(policies, "WorldModel", build)
            patch.setattr(dreamer_v2.dreamer_v2, "Learner", build)
            with pytest.raises(error, match=message):
                tiny_model(env, **kwargs)

    return check


def _image(*shape, low=0, high=255, dtype=np.uint8):
    return spaces.Box(low, high, shape, dtype)


# -- spaces ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (spaces.Discrete(4), r"needs image observations: Box\(0, 255.*got Discrete\(4\)"),
        (_image(16, 16, 3, high=1, dtype=np.float32), "needs image observations.*float32"),
        (_image(12, low=-1, high=1, dtype=np.float32), r"needs image observations.*\(12,\)"),
        (_image(16, 16, 3, high=100), "needs image observations.*100"),
        (spaces.Dict({"image": _image(16, 16, 3)}), "needs image observations.*Dict|dict observation space"),
        (_image(16, 12, 3), "must be 16 to 512 pixels high and wide, got 16×12"),
        (_image(12, 16, 3), "must be 16 to 512 pixels high and wide, got 12×16"),
        (_image(520, 520, 1), "must be 16 to 512 pixels high and wide, got 520×520"),
    ],
)
def test_observation_spaces(refused, space, message):
    refused(message, CounterEnv(observation_space=space))


@pytest.mark.parametrize(
    ("policy", "space", "message"),
    [
        ("MlpPolicy", spaces.Text(3), r"MlpPolicy needs one of the observation spaces Box, .*got Text"),
        ("MlpPolicy", spaces.Tuple([spaces.Discrete(2)]), r"MlpPolicy needs one of the observation spaces .*got Tuple"),
        ("MultiInputPolicy", spaces.Discrete(4), r"MultiInputPolicy needs a Dict of observations, got Discrete\(4\)"),
        ("MultiInputPolicy", spaces.Dict({"a": spaces.Text(3)}), "Observation 'a': MlpPolicy needs .*got Text"),
        ("MultiInputPolicy", spaces.Dict({"a": _image(3, 12, 12)}), "Observation 'a': Images must be 16 to 512.*12×12"),
    ],
)
def test_observation_spaces_of_other_policies(policy, space, message):
    with pytest.raises(UnsupportedSpaceError, match=message):
        DreamerV2.policy_aliases[policy].check_spaces(space, spaces.Discrete(2))


@pytest.mark.parametrize(
    ("space", "message"),
    [
        (_image(16, 16, 3, low=-np.inf, high=np.inf, dtype=np.float32), "Images need finite bounds"),
        (_image(16, 16, 3, high=1, dtype=np.float32), "must have their channels first.*or return uint8"),
        (_image(7, high=1, dtype=np.float32), "needs image observations"),
    ],
)
def test_float_images(refused, space, message):
    refused(message, CounterEnv(observation_space=space), policy_kwargs={"normalize_images": False})


def test_normalised_images(refused):
    """VecNormalize makes floats of uint8 images."""
    refused(r"VecNormalize\(norm_obs=False\) for images", VecNormalize(DummyVecEnv([CounterEnv])))


@pytest.mark.parametrize("error", [ValueError, AssertionError])
@pytest.mark.parametrize("space", [spaces.MultiBinary(3), spaces.Dict({"a": spaces.Discrete(2)})])
def test_action_spaces(refused, space, error):
    """A wrong value as everywhere here, and what SB3 raises."""
    refused(
        f"needs a Box, Discrete or MultiDiscrete action space, got {type(space).__name__}",
        CounterEnv(action_space=space),
        error,
    )


def test_action_noise_needs_numbers(refused):
    noise = NormalActionNoise(np.zeros(2), np.ones(2))
    refused(
        r"action_noise=.* needs a Box action space, got Discrete\(2\)",
        CounterEnv(action_space=spaces.Discrete(2)),
        action_noise=noise,
    )


def test_unbounded_actions(refused):
    refused("finite", CounterEnv(action_space=spaces.Box(-np.inf, np.inf, (2,))), error=AssertionError)


@pytest.mark.filterwarnings("ignore:invalid value")
def test_an_action_without_range_is_refused_or_harmless(tiny_model):
    space = spaces.Box(np.array([-1, 2], np.float32), np.array([1, 2], np.float32))
    try:
        model = tiny_model(CounterEnv(8, action_space=space), intrinsic_reward="lbs")
    except ValueError:
        return
    model.learn(24)
    assert all(th.isfinite(value).all() for value in model.policy.state_dict().values())


# -- numbers ---------------------------------------------------------------------------------------------------------------


def _wrong_integers():
    for name, least in INTEGERS.items():
        for value in (least - 1, -5, 1.5, "7", None, True, math.nan):
            yield name, value


@pytest.mark.parametrize(("name", "value"), list(_wrong_integers()))
def test_integers(refused, name, value):
    refused(rf"{name} must be an integer of at least {INTEGERS[name]}, got {value!r}", **{name: value})


def _wrong_numbers():
    for name, (low, low_ok, high, high_ok) in NUMBERS.items():
        yield from ((name, value) for value in (low - 1, math.nan, "0.5", None))
        if not low_ok:
            yield name, low
        if not high_ok:
            yield name, high
        if high < math.inf:
            yield name, high + 1


@pytest.mark.parametrize(("name", "value"), list(_wrong_numbers()))
def test_numbers(refused, name, value):
    refused(rf"{name} must lie in [\[(].*, got {value!r}", **{name: value})


@pytest.mark.parametrize("name", ["learning_rate", "actor_learning_rate", "critic_learning_rate", "ent_coef"])
@pytest.mark.parametrize("value", [-1e-3, math.nan, math.inf])
def test_rates(refused, name, value):
    refused(f"{name} must be a non-negative number.*got {value!r}", **{name: value})


@pytest.mark.parametrize(
    "value", [0, -4, 2.5, (0, "step"), (-1, "episode"), [1, "episode"], (4,), (), (4, "step", 1), (4, None)]
)
def test_train_freq(refused, value):
    refused(r'train_freq must be a positive integer, or one with its unit, as \(1, "episode"\), got', train_freq=value)


def test_train_freq_unit(refused):
    refused("train_freq", train_freq=(1, "year"))


@pytest.mark.parametrize("value", [-2, 1.5, None])
def test_gradient_steps(refused, value):
    refused(f"gradient_steps must be -1 or a non-negative integer, got {value!r}", gradient_steps=value)


@pytest.mark.parametrize("size", ["deter_size", "hidden_size", "stoch_variables", "stoch_classes", "cnn_depth"])
@pytest.mark.parametrize("value", [0, -1, 2.5, "8", None])
def test_network_sizes(refused, size, value):
    refused(f"policy_kwargs: {size} must be a positive integer, got {value!r}", policy_kwargs={size: value})


@pytest.mark.parametrize(("net_arch", "message"), [([8, 0], r"net_arch\[1\].*got 0"), ([2.5], r"net_arch\[0\]")])
def test_net_arch(refused, net_arch, message):
    refused(message, policy_kwargs={"net_arch": net_arch})


@pytest.mark.parametrize("name", ["learning_rate", "actor_learning_rate", "critic_learning_rate"])
def test_a_rate_that_is_a_text(refused, name):
    """What YAML makes of a bare 1e-4."""
    refused(f"{name} must be a non-negative number or a schedule, got '1e-4'", **{name: "1e-4"})


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        *(
            ({"seed": value}, r"seed must be an integer in \[0, 2\*\*32\), or None, got")
            for value in ("a", -1, 1.5, 2**32, True)
        ),
        *(
            ({"stats_window_size": value}, "stats_window_size must be an integer of at least 1")
            for value in (0, "a", 2.5, None)
        ),
        ({"tensorboard_log": 3}, "tensorboard_log must be the path of a folder or None, got 3"),
        *(({"verbose": value}, f"verbose must be 0, 1 or 2, got {value!r}") for value in ("x", 3, None)),
        *(
            ({name: 3}, f"{name} must be a dictionary or None, got 3")
            for name in ("policy_kwargs", "replay_buffer_kwargs", "planner_kwargs")
        ),
    ],
)
def test_settings(refused, kwargs, message):
    refused(message, **kwargs)


def test_a_path_of_the_log(tiny_model, tmp_path):
    model = tiny_model(tensorboard_log=tmp_path / "tb").learn(20)
    model.save(tmp_path / "model")
    assert list((tmp_path / "tb").rglob("events*")) and DreamerV2.load(tmp_path / "model").tensorboard_log == str(
        tmp_path / "tb"
    )


# -- names -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"preset": "huge"}, "Unknown preset 'huge'; known are .*'paper', 'small', 'state', 'state-small', 'tiny'"),
        ({"intrinsic_reward": "lbz"}, "Unknown intrinsic_reward 'lbz'; known are .*'lbs'"),
        (
            {"intrinsic_reward": 3},
            "intrinsic_reward must be a name, a subclass or an instance of IntrinsicReward, or None, got 3",
        ),
        ({"intrinsic_reward": dict}, "intrinsic_reward must be a name.*dict"),
        ({"planner": "cem"}, "Unknown planner 'cem'; known are .*'dyna_mpc'.*'mppi'"),
        (
            {"planner": "dyna_mpc", "planner_kwargs": {"elites": 3}},
            r"Unknown planner_kwargs \['elites'\]; known are .*'top_k'",
        ),
        ({"planner": "dyna_mpc", "planner_kwargs": {"horizon": 1}}, "planner horizon must be an integer of at least 2, got 1"),
        (
            {"planner": "dyna_mpc", "planner_kwargs": {"top_k": 11}},
            r"planner top_k must be at most .*n_samples=8 and 2 of the actor.*got 11",
        ),
    ],
)
def test_names(refused, kwargs, message):
    refused(message, **kwargs)


def test_planner_kwargs_without_a_planner(refused):
    refused("elites", planner_kwargs={"elites": 3})


def test_unknown_policy():
    with pytest.raises(ValueError, match=r"Unknown policy 'LstmPolicy'; known are .*'CnnPolicy'"):
        DreamerV2("LstmPolicy", CounterEnv(), preset="tiny")


def test_unknown_policy_kwargs(refused):
    refused(r"Unknown policy_kwargs \['deter'\]", policy_kwargs={"deter": 3})


def test_unknown_keyword():
    with pytest.raises(TypeError, match="horizon"):
        DreamerV2("CnnPolicy", CounterEnv(), preset="tiny", horizon=3)


def test_unknown_task():
    with pytest.raises(gymnasium.error.Error, match="walker-fly"):
        DreamerV2("CnnPolicy", "urlb/walker-fly-v0", preset="tiny")
    with pytest.raises(ValueError, match=r"Unknown task 'walker-fly'; known are .*walker-walk"):
        normalized_score("walker-fly", 3.0)


def test_a_taken_name_of_an_intrinsic_reward():
    register_intrinsic_reward("lbs", LBS)  # again: harmless
    with pytest.raises(ValueError, match="'lbs' is already LBS"):
        register_intrinsic_reward("lbs", type("Other", (LBS,), {}))


# -- replay ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("buffer_class", [HerReplayBuffer, ReplayBuffer])
def test_other_replay_buffers(refused, buffer_class):
    refused(f"must be a subclass of SequenceReplayBuffer, got .*{buffer_class.__name__}", replay_buffer_class=buffer_class)


def test_a_batch_longer_than_the_buffer(refused):
    refused("batch_length=10 must not exceed buffer_size=9", batch_length=10, buffer_size=9)


@pytest.mark.parametrize("kwargs", [{"elites": 3}, {"batch_length": 5}, {"max_episode_rows": 3}])
def test_replay_buffer_kwargs(refused, kwargs):
    refused(
        r"Unknown replay_buffer_kwargs \['(elites|batch_length)'\]; known are .*'store'|max_episode_rows=3",
        replay_buffer_kwargs=kwargs,
    )


class _WithSpec(gymnasium.Wrapper):
    """What ``gymnasium.make`` adds: a spec that tells the time limit."""

    spec = gymnasium.envs.registration.EnvSpec("Counter-v0", max_episode_steps=8)


ENVS = {
    "attribute": lambda: CounterEnv(8, max_episode_steps=8),
    "spec": lambda: _WithSpec(TimeLimit(CounterEnv(None), 8)),
    "vectorised": lambda: DummyVecEnv([lambda: CounterEnv(8, max_episode_steps=8)] * 2),
}


@pytest.mark.parametrize("make_env", ENVS.values(), ids=ENVS)
def test_a_batch_longer_than_any_episode(refused, tiny_model, make_env):
    refused("batch_length=10 is longer than any episode.*after 8 steps", make_env(), batch_length=10)
    tiny_model(make_env(), batch_length=9)  # an episode has the reset's row, too


def test_a_batch_longer_than_any_episode_of_the_next_environment(tiny_model):
    model = tiny_model(intrinsic_reward="lbs", batch_length=10)
    with pytest.raises(ValueError, match="batch_length=10"):
        model.fine_tune(CounterEnv(5, max_episode_steps=5))


def test_a_run_of_short_episodes_stops(tiny_model):
    model = tiny_model(CounterEnv([1, 2]), batch_length=4)
    with pytest.raises(ValueError, match=r"batch_length=4 is longer than any of the first 5. episodes.*3 rows"):
        model.learn(1000)
    assert SHORT_EPISODES <= model.replay_buffer.finished_count < SHORT_EPISODES + 4


def test_short_episodes_are_enough_where_sequences_run_through_several(tiny_model):
    env = CounterEnv([1, 2], max_episode_steps=2, terminates=True)
    model = tiny_model(env, batch_length=10, replay_buffer_kwargs={"sampling": "rows"}).learn(200)
    assert model._n_updates > 0


def test_a_long_episode_among_short_ones_is_enough(tiny_model):
    model = tiny_model(CounterEnv([1] * 30 + [5]), batch_length=4).learn(200)
    assert model._n_updates > 0


# -- predict ---------------------------------------------------------------------------------------------------------------

VECTOR = spaces.Box(-1, 1, (3,), np.float32)
OBSERVATIONS = [
    ("CnnPolicy", None, [1, 2, 3], r"must have the shape \(3, 16, 16\), its channels first or last.*got \(3,\)"),
    ("CnnPolicy", None, np.zeros((3, 16)), r"must have the shape \(3, 16, 16\).*got \(3, 16\)"),
    ("CnnPolicy", None, None, r"must be numbers of the shape \(3, 16, 16\).*got NoneType 'None'"),
    ("MlpPolicy", VECTOR, [[1], [2, 3]], r"must be numbers of the shape \(3,\).*got list '\[\[1\], \[2, 3\]\]'"),
    ("MlpPolicy", VECTOR, "abc", r"must be numbers of the shape \(3,\).*got str 'abc'"),
    ("MlpPolicy", VECTOR, [1, 2], r"Unexpected observation shape \(2,\)"),
    ("MultiInputPolicy", spaces.Dict({"a": VECTOR}), [1, 2, 3], r"must be a dictionary of \['a'\], got list"),
    ("MultiInputPolicy", spaces.Dict({"a": VECTOR}), {"b": [1]}, r"has the parts \['b'\]; known are \['a'\]"),
    ("MultiInputPolicy", spaces.Dict({"a": VECTOR}), {"a": "x"}, r"The observation 'a' must be numbers of the shape \(3,\)"),
]


@pytest.mark.parametrize(("policy", "space", "observation", "message"), OBSERVATIONS)
def test_observations_that_are_none(tiny_model, policy, space, observation, message):
    model = tiny_model(CounterEnv(observation_space=space), policy)
    with pytest.raises(ValueError, match=message):
        model.predict(observation)


def test_a_list_of_the_right_shape_is_an_observation(tiny_model):
    model = tiny_model(CounterEnv(observation_space=VECTOR), "MlpPolicy")
    action, _ = model.predict([0.1, 0.2, 0.3], deterministic=True)
    assert np.array_equal(action, model.predict(np.array([0.1, 0.2, 0.3], np.float32), deterministic=True)[0])


# -- load ------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kwargs", "error", "message"),
    [
        ({"batch_size": 0}, ValueError, "^batch_size must be an integer of at least 1, got 0"),
        ({"custom_objects": {"gamma": 3}}, ValueError, r"^gamma must lie in \(0, 1\], got 3"),
        ({"custom_objects": 3}, TypeError, "^custom_objects must be a dictionary of arguments by name or None, got 3"),
        ({"device": "nonsense"}, RuntimeError, r"^device must be .*, got 'nonsense'\.$"),
        ({"env": 3}, ValueError, "^env must be an environment of Gymnasium, a VecEnv or an id, got 3"),
        ({"seed": "a"}, ValueError, r"^seed must be an integer .*got 'a'"),
        ({"planner": "cem"}, ValueError, "^Unknown planner 'cem'"),
    ],
)
def test_load_blames_the_file_only_for_what_is_in_it(tiny_model, tmp_path, kwargs, error, message):
    tiny_model().save(tmp_path / "model")
    with pytest.raises(error, match=message) as caught:
        DreamerV2.load(tmp_path / "model", **kwargs)
    assert not isinstance(caught.value, SnapshotError)
    # What is wrong with the file stays its fault, whatever is given beside it.
    broken = change_data(tmp_path / "model.zip", tmp_path / "broken.zip", lambda data: data["arguments"].update(gae_lambda=7))
    with pytest.raises(SnapshotError, match=r"broken\.zip is refused: gae_lambda must lie in"):
        DreamerV2.load(broken, batch_size=3)
    # Nor is an environment that does not fit the file's fault.
    with pytest.raises(ValueError, match="spaces do not match") as caught:
        DreamerV2.load(tmp_path / "model", env=CounterEnv(size=20))
    assert not isinstance(caught.value, SnapshotError)


# -- while it runs ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("reward", [math.nan, math.inf, -math.inf])
def test_a_reward_that_is_no_number(tiny_model, reward):
    envs = [CounterEnv(50), CounterEnv(50, rewards=[0.0, 0.0, 0.0, reward])]
    model = tiny_model(DummyVecEnv([lambda i=i: envs[i] for i in range(2)]))
    with pytest.raises(ValueError, match=f"Environment 1, step 8: the reward is {reward}; expected finite numbers"):
        model.learn(40)
    assert model.replay_buffer.size() == 2 * 4  # the bad row was not stored


def test_an_environment_of_other_spaces(tiny_model):
    with pytest.raises(ValueError, match="spaces do not match"):
        tiny_model().set_env(CounterEnv(size=20))


@pytest.mark.parametrize("frames", [0, -1])
def test_callbacks(tmp_path, frames):
    with pytest.raises(ValueError, match=f"pretrain_frames must be a positive integer, got {frames}"):
        PhaseSwitchCallback(frames)
    with pytest.raises(ValueError, match=rf"frames must be a sequence of positive integers, got \[100, {frames}\]"):
        SnapshotCallback(tmp_path / "snapshots", [100, frames])


def test_numpy_integers_are_integers(tiny_model):
    """What a search over hyperparameters hands in."""
    model = tiny_model(batch_size=np.int64(3))
    assert model.batch_size == 3


def test_a_refused_environment_leaves_torch_as_it_was(refused):
    before = th.get_rng_state()
    refused("batch_length", batch_length=1)
    assert th.equal(before, th.get_rng_state())
