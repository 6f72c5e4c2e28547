"""What users hand to either algorithm meets the same rules: one clear error before anything is built."""

from __future__ import annotations

import inspect
import re

import gymnasium
import numpy as np
import pytest
import torch as th
from fake_envs import CounterEnv
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from stable_baselines3.sac.policies import SACPolicy

from sb3_dreamer_urlb import DreamerV2, DrQv2, FineTuneCallback, PhaseSwitchCallback, SnapshotError
from sb3_dreamer_urlb.dreamer_v2.policies import DreamerPolicy
from sb3_dreamer_urlb.drq_v2.policies import DrQPolicy
from sb3_dreamer_urlb.intrinsic import TransitionReward
from sb3_dreamer_urlb.replay import SequenceReplayBuffer
from sb3_dreamer_urlb.replay.n_step import NStepFrameReplayBuffer
from sb3_dreamer_urlb.spaces.observation_checks import checked_observation

#: algorithm, its policies, its replay, a way to explore
KINDS = [
    (DreamerV2, DreamerPolicy, SequenceReplayBuffer, "lbs"),
    (DrQv2, DrQPolicy, NStepFrameReplayBuffer, "disagreement"),
]
each = pytest.mark.parametrize(("algorithm", "policy", "replay", "method"), KINDS, ids=["dreamer_v2", "drq_v2"])


def make(algorithm, policy="CnnPolicy", **kwargs):
    return algorithm(policy, CounterEnv(9), **{"preset": "tiny", "seed": 0, "device": "cpu", **kwargs})


@each
@pytest.mark.parametrize("given", [SACPolicy, th.nn.Linear, dict, 3, None, len])
def test_a_policy_that_is_none_of_its_own_is_named(algorithm, policy, replay, method, given):
    with pytest.raises(ValueError, match=rf"policy must be one of \['CnnPolicy', .*or a subclass of {policy.__name__}, got "):
        make(algorithm, given)


@each
def test_each_refuses_the_others_policy(algorithm, policy, replay, method):
    (other,) = (kind for _, kind, *_ in KINDS if kind is not policy)
    with pytest.raises(ValueError, match=f"subclass of {policy.__name__}, got .*{other.__name__}"):
        make(algorithm, other)


@each
@pytest.mark.parametrize("name", ["stor", "optimize_memory_usage", "buffer_size", "device", "n_envs", "phase", "batch_length"])
def test_arguments_that_the_replay_has_not_are_named(algorithm, policy, replay, method, name):
    with pytest.raises(
        ValueError, match=rf"Unknown replay_buffer_kwargs \['{name}'\]; known are .*'max_episode_rows'.*'store'"
    ):
        make(algorithm, replay_buffer_kwargs={name: 1})


@each
def test_arguments_of_a_replay_of_ones_own_are_known(algorithm, policy, replay, method):
    class Own(replay):
        def __init__(self, *args, shade=0, **kwargs):
            super().__init__(*args, **kwargs)
            self.shade = shade

    assert make(algorithm, replay_buffer_class=Own, replay_buffer_kwargs={"shade": 7}).replay_buffer.shade == 7


BAD_CHOICES = [
    *(({"keep_actor": value}, f"keep_actor must be True, False or None, got {value!r}") for value in ("yes", 1, 0)),
    *(({"keep_critic": value}, f"keep_critic must be True or False, got {value!r}") for value in (None, "no", 0)),
    *(({"keep_reward": value}, f"keep_reward must be True or False, got {value!r}") for value in (None, "no", 1)),
]


@each
@pytest.mark.parametrize(("kwargs", "message"), BAD_CHOICES)
def test_what_fine_tuning_keeps_is_true_or_false(algorithm, policy, replay, method, kwargs, message):
    model = make(algorithm, intrinsic_reward=method)
    with pytest.raises(ValueError, match=message):
        model.fine_tune(**kwargs)
    assert model.phase == "pretraining"


@pytest.mark.parametrize("callback", [PhaseSwitchCallback, FineTuneCallback])
@pytest.mark.parametrize(("kwargs", "message"), BAD_CHOICES)
def test_callbacks_say_so_when_they_are_made(callback, kwargs, message):
    with pytest.raises(ValueError, match=message):
        callback(**kwargs)
    assert callback(keep_actor=np.bool_(True)).keep_actor is True


# -- assigned --------------------------------------------------------------------------------------------------------------

#: another value for each argument of DrQv2 that can be assigned
VALUES = {
    "learning_rate": 2e-4,
    "adam_eps": 1e-3,
    "batch_size": 3,
    "tau": 0.5,
    "gamma": 0.5,
    "noise_std": (1.0, 0.5, 20),
    "noise_clip": 0.1,
    "learning_starts": 12,
    "train_freq": 2,
    "gradient_steps": 2,
    "action_noise": NormalActionNoise([0.0, 0.0], [0.1, 0.1]),
    "overlap": False,
    "verbose": 0,
    "tensorboard_log": None,
}


def test_the_values_are_all_there_are():
    assert VALUES.keys() == DrQv2.assignable


@pytest.mark.parametrize("name", sorted(VALUES))
def test_an_assigned_model_is_one_that_was_made_so(weights, name):
    assigned, made = make(DrQv2), make(DrQv2, **{name: VALUES[name]})
    setattr(assigned, name, VALUES[name])
    for model in (assigned, made):
        model.set_random_seed(1)
        model.learn(24)
    assert weights(assigned.policy) == weights(made.policy)
    assert assigned.learner.config == made.learner.config
    if name not in ("overlap", "verbose", "tensorboard_log"):
        assert weights(make(DrQv2).learn(24).policy) != weights(made.policy)


@pytest.mark.parametrize("name", sorted(set(DrQv2.argument_names()) - VALUES.keys() - {"stats_window_size"}))
def test_what_was_built_is_not_assigned(name):
    model = make(DrQv2)
    before = getattr(model, name)
    way = r"another model, DrQv2\(\.\.\., " if name in DrQv2.of_the_networks else r"DrQv2.load\(path, "
    with pytest.raises(AttributeError, match=rf"{name} cannot be assigned.*{way}{name}=\.\.\.\)"):
        setattr(model, name, before)
    assert getattr(model, name) is before


#: another value for each argument that neither can be assigned nor belongs to the networks
LOADED = {
    "n_steps": 2, "buffer_size": 500, "replay_buffer_class": None, "replay_buffer_kwargs": {"max_episode_rows": 50},
    "precision": "bfloat16", "compile": "eager", "seed": 5, "stats_window_size": 7, "freeze_encoder": True,
    "batch_length": 5, "discount_head": True, "warmup_actions": "saturated", "actor_gradient": "dynamics",
    "reward_trains_model": False, "freeze_decoder": True,
}  # fmt: skip


@each
def test_what_a_message_says_of_load_is_true(tmp_path, algorithm, policy, replay, method):
    """Of a model that was trained, so that its optimisers have moments."""
    make(algorithm, intrinsic_reward=method).learn(30).save(tmp_path / "model")
    names = set(algorithm.argument_names()) - algorithm.assignable - algorithm.of_the_networks
    assert names <= LOADED.keys()
    for name in sorted(names):
        model = algorithm.load(tmp_path / "model", env=CounterEnv(9), device="cpu", **{name: LOADED[name]})
        found = getattr(model, {"stats_window_size": "_stats_window_size"}.get(name, name))
        assert found == LOADED[name], name


@pytest.mark.parametrize(
    ("algorithm", "method", "name", "value"),
    [
        (DreamerV2, "plan2explore", "policy_kwargs", {"net_arch": [9]}),
        (DreamerV2, "plan2explore", "intrinsic_kwargs", {"ensemble_size": 3}),
        (DreamerV2, "plan2explore", "discount_head", False),
        (DrQv2, "disagreement", "policy_kwargs", {"net_arch": [9]}),
        (DrQv2, "disagreement", "intrinsic_kwargs", {"trains_encoder": False}),
        (DrQv2, "disagreement", "frame_stack", 2),
    ],
)
@pytest.mark.parametrize("custom", [False, True])
def test_load_names_the_argument_that_the_networks_do_not_fit(tmp_path, algorithm, method, name, value, custom):
    make(algorithm, intrinsic_reward=method).learn(30).save(tmp_path / "model")
    given = {name: value, "gamma": 0.5}
    with pytest.raises(SnapshotError, match=rf"made with another {name} than {name}="):
        algorithm.load(tmp_path / "model", device="cpu", **({"custom_objects": given} if custom else given))


# -- of any type -----------------------------------------------------------------------------------------------------------


#: what no argument takes, in forms that comparisons, look-ups and divisions raise at
STRANGE = [np.array([1, 2]), [object()], b"x", 1j, {1: 2}]
#: what is left to Stable-Baselines3 and torch
LEFT = {"self", "policy", "env", "device", "_init_setup_model"}
NAMES = [(kind, name) for kind, *_ in KINDS for name in inspect.signature(kind).parameters if name not in LEFT]


@pytest.mark.parametrize(("algorithm", "name"), NAMES, ids=lambda value: getattr(value, "__name__", value))
def test_arguments_of_any_type_are_named(algorithm, name):
    for value in STRANGE:
        with pytest.raises(ValueError, match=name):
            make(algorithm, **{name: value})


@each
@pytest.mark.parametrize("name", ["policy_kwargs", "replay_buffer_kwargs"])
@pytest.mark.parametrize("value", [0, "", (), False, [1], np.array([1, 2])])
def test_what_is_false_is_no_dictionary(algorithm, policy, replay, method, name, value):
    with pytest.raises(ValueError, match=f"{name} must be a dictionary or None, got"):
        make(algorithm, **{name: value})


@each
@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"replay_buffer_kwargs": {"seed": "a"}}, "seed must be an integer of at least 0, got 'a'"),
        ({"replay_buffer_kwargs": {"max_episode_rows": "9"}}, "max_episode_rows must be an integer of at least 1, got '9'"),
        ({"replay_buffer_kwargs": {"max_episode_rows": 0}}, "max_episode_rows must be an integer of at least 1, got 0"),
        ({"policy_kwargs": {"normalize_images": "x"}}, "normalize_images must be True or False, got 'x'"),
        ({"preset": [1]}, r"Unknown preset \[1\]"),
    ],
)
def test_their_parts_are_named(algorithm, policy, replay, method, kwargs, message):
    with pytest.raises(ValueError, match=message):
        make(algorithm, **kwargs)


@each
@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        *(
            ({"total_timesteps": value}, "total_timesteps must be a number")
            for value in ("5", float("nan"), None, [5], True, -3)
        ),
        *(({"callback": value}, "callback must be a .*, got") for value in ("eval", BaseCallback, [5], [print])),
        ({"reset_num_timesteps": "no"}, "reset_num_timesteps must be True or False, got 'no'"),
        ({"progress_bar": 1}, "progress_bar must be True or False, got 1"),
        *(({"log_interval": value}, "log_interval must be an integer of at least 1") for value in (0, -1, "4", 2.5)),
    ],
)
def test_learn_says_what_it_takes(algorithm, policy, replay, method, kwargs, message):
    model = make(algorithm)
    with pytest.raises(ValueError, match=message):
        model.learn(**{"total_timesteps": 8, **kwargs})
    assert model.num_timesteps == 0 and model.learn(4.0, log_interval=None).num_timesteps == 4


@each
@pytest.mark.parametrize(
    ("name", "near"),
    [
        ("intrinsic", "'intrinsic_(kwargs|reward)' or 'intrinsic_(kwargs|reward)'"),
        ("intrinsic_reward_kwargs", ".*'intrinsic_kwargs'"),
        ("Learning_Rate", "'learning_rate'"),
        ("freq", "'train_freq'"),
        ("zzz", None),
    ],
)
def test_an_argument_that_it_has_not_is_named_with_those_that_are_near(
    algorithm, policy, replay, method, name, near, tmp_path
):
    path = tmp_path / "model"
    make(algorithm).save(path)
    me = algorithm.__name__
    for caller, call in (
        (me, lambda: make(algorithm, **{name: 1})),
        (f"{me}.load", lambda: algorithm.load(path, **{name: 1})),
        (f"{me}.resume", lambda: algorithm.resume(tmp_path, **{name: 1})),
    ):
        with pytest.raises(TypeError) as caught:
            call()
        question = "" if near is None else rf" Did you mean {near}\?"
        assert re.fullmatch(
            rf"{caller}: got an unexpected keyword argument '{name}'\.{question} help\({me}\) lists all\.", str(caught.value)
        )


@each
def test_a_key_of_a_dictionary_is_answered_with_the_dictionary(algorithm, policy, replay, method, tmp_path):
    make(algorithm).save(tmp_path / "model")
    names = {"net_arch": "policy_kwargs", "store": "replay_buffer_kwargs"}
    if algorithm is DreamerV2:
        names["horizon"] = "planner_kwargs"
    for name, dictionary in names.items():
        for call in (
            lambda name=name: make(algorithm, **{name: 1}),
            lambda name=name: algorithm.load(tmp_path / "model", **{name: 1}),
        ):
            with pytest.raises(
                TypeError, match=rf"'{name}'\. {name} is a key of {dictionary}: {dictionary}={{'{name}': \.\.\.}}\. h"
            ):
                call()


@each
def test_what_load_changes_nothing_by_is_answered_in_its_own_words(algorithm, policy, replay, method, tmp_path):
    make(algorithm).save(tmp_path / "model")
    for name, message in (
        ("preset", r"make a new model, \w+\(\.\.\., preset=\.\.\.\)"),
        ("policy", "custom_objects={'policy'"),
    ):
        with pytest.raises(TypeError, match=f"got an unexpected keyword argument '{name}': .*{message}") as caught:
            algorithm.load(tmp_path / "model", **{name: "small"})
        assert len(str(caught.value)) < 300


@each
def test_keys_of_dictionaries_are_answered_with_what_is_near(algorithm, policy, replay, method):
    for kwargs, message in (
        ({"policy_kwargs": {"netarch": [8]}}, r"Unknown policy_kwargs \['netarch'\]; known are .* Did you mean 'net_arch'\?"),
        ({"replay_buffer_kwargs": {"rows": 8}}, "Did you mean 'max_episode_rows'"),
        ({"preset": "Small"}, "Unknown preset 'Small'; known are .* Did you mean 'small'"),
        ({"policy": "CNNPolicy"}, "Unknown policy 'CNNPolicy'; known are .* Did you mean 'CnnPolicy'"),
        ({"intrinsic_reward": method[:-1]}, f"Did you mean '{method}'"),
    ):
        with pytest.raises(ValueError, match=message):
            make(algorithm, **kwargs)


# -- predict ---------------------------------------------------------------------------------------------------------------


@each
def test_a_state_of_another_policy_is_refused(algorithm, policy, replay, method):
    model = make(algorithm)
    observation, _ = CounterEnv().reset()
    _, state = model.predict(observation)
    count = len(state)
    for wrong, message in (
        (state[:1], f"a tuple of {count} arrays, got a tuple of 1"),
        (list(state), f"a tuple of {count} arrays, got list"),
        ((state[0][..., :1], *state[1:]), "arrays of the shapes"),
        ((state[0], np.zeros((1, 7), np.float32), *state[2:]), r"got .*\(1, 7\)"),
        ((state[0], np.float32(1), *state[2:]), "environments"),
    ):
        with pytest.raises(ValueError, match=message):
            model.predict(observation, wrong)
    model.predict(observation, state)


@each
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_observations_that_are_not_finite_are_refused(algorithm, policy, replay, method, value):
    space = spaces.Box(-1, 1, (3,), np.float32)
    model = algorithm("MlpPolicy", CounterEnv(observation_space=space), preset="tiny", device="cpu")
    with pytest.raises(ValueError, match=r"must be finite, got \[0.0, .*\]"):
        model.predict(np.array([0, value, 0], np.float32))


@pytest.mark.parametrize("shape", [(24,), (2, 30)])
def test_long_observations_are_shown_by_their_ends(shape):
    space = spaces.Box(-1, 1, shape[-1:], np.float32)
    observation = np.zeros(shape, np.float32)
    observation[..., -1] = np.nan
    with pytest.raises(ValueError) as told:
        checked_observation(observation, space)
    count = observation.size // shape[-1]
    assert str(told.value) == (
        f"The observation must be finite, got [0, 0, ..., 0, nan] of the shape {shape}, "
        f"{count} of {observation.size} not finite."
    )
    classes = spaces.MultiDiscrete([3] * 60)
    with pytest.raises(ValueError, match=r"got \[9, 9, \.\.\., 9, 9\] of the shape \(60,\)\.$"):
        checked_observation(np.full(60, 9), classes)
    with pytest.raises(ValueError, match=r"got str 'o{77}\.\.\.'"):
        checked_observation("o" * 100, space)


@pytest.mark.parametrize(("name", "value"), [("tau", 0), ("gamma", "x"), ("noise_std", -1), ("learning_rate", None)])
def test_bad_values_leave_the_old_ones(name, value):
    model = make(DrQv2)
    before, config = getattr(model, name), model.learner.config
    with pytest.raises(ValueError, match=name):
        setattr(model, name, value)
    assert getattr(model, name) == before and model.learner.config is config


# -- a method of one's own -------------------------------------------------------------------------------------------------


def test_a_method_that_does_not_say_what_a_step_is_worth_is_refused():
    class Silent(TransitionReward):
        pass

    with pytest.raises(ValueError, match=r"Silent does not say what its reward is"):
        make(DrQv2, intrinsic_reward=Silent)
    with pytest.raises(TypeError, match="reward"):
        Silent()


@each
@pytest.mark.parametrize("bad", [lambda _: -1.0, lambda _: float("nan"), lambda _: None, lambda: 1.0, lambda _: 1 / 0])
def test_a_schedule_that_gives_no_rate_is_named(algorithm, policy, replay, method, bad):
    with pytest.raises(ValueError, match="learning_rate must "):
        make(algorithm, learning_rate=bad)
    model = make(algorithm)
    before = model.learning_rate
    with pytest.raises(ValueError, match="learning_rate must "):
        model.learning_rate = bad
    assert model.learning_rate == before


@each
@pytest.mark.parametrize("later", [-1e-9, float("nan"), float("inf")])
def test_a_schedule_that_ends_badly_changes_no_weights(algorithm, policy, replay, method, later):
    model = make(algorithm, learning_rate=lambda left: 1e-3 if left > 0.5 else later)
    with pytest.raises(ValueError, match=r"The schedule of .* must give non-negative numbers: with 0.* of the run left it"):
        model.learn(60)
    assert all(th.isfinite(weight).all() for weight in model.policy.parameters())


# -- environments ----------------------------------------------------------------------------------------------------------

WRONG_ENVS = {
    "gymnasium's vectorised": (
        lambda: gymnasium.vector.SyncVectorEnv([CounterEnv] * 2),
        "env is vectorised by Gymnasium, a SyncVectorEnv.*make it with make_vec_env",
    ),
    "text in a Dict": (
        lambda: CounterEnv(observation_space=spaces.Dict({"a": spaces.Text(3), "b": spaces.Discrete(2)})),
        "The observation 'a' must be an array of numbers.*got Text",
    ),
    "a sequence": (lambda: CounterEnv(observation_space=spaces.Sequence(spaces.Discrete(2))), "must be arrays.*got Sequence"),
}


@each
@pytest.mark.parametrize(("wrong", "message"), WRONG_ENVS.values(), ids=WRONG_ENVS)
def test_an_environment_that_will_not_do_is_named_wherever_it_is_given(
    algorithm, policy, replay, method, wrong, message, tmp_path
):
    model = make(algorithm, intrinsic_reward=method)
    model.save(tmp_path / "m")
    ways = (
        lambda: algorithm("CnnPolicy", wrong(), preset="tiny"),
        lambda: model.set_env(wrong()),
        lambda: model.fine_tune(wrong()),
        lambda: algorithm.load(tmp_path / "m", wrong(), device="cpu"),
    )
    for way in ways:
        with pytest.raises(ValueError, match=message):
            way()
    assert model.phase == "pretraining"


@each
def test_the_device_is_not_assigned(algorithm, policy, replay, method, tmp_path):
    model = make(algorithm)
    model.device = "cpu"  # it is there
    assert model.device == th.device("cpu")
    with pytest.raises(AttributeError, match=r"device cannot be assigned: .* device='cpu'.*load\(path, device=\.\.\.\)"):
        model.device = "meta"
    with pytest.raises(AttributeError, match="stats_window_size=100"):
        model.stats_window_size = 7
    model.save(tmp_path / "m")


@each
def test_an_assigned_environment_is_set(algorithm, policy, replay, method):
    space = spaces.Box(-1, 1, (3,), np.float32)

    def other():
        return CounterEnv(9, observation_space=space)

    model = algorithm("MlpPolicy", other(), preset="tiny", seed=0, device="cpu").learn(20)
    for env in (other(), DummyVecEnv([other]), VecNormalize(DummyVecEnv([other]), norm_obs=False)):
        model.env = env
        assert model._last_obs is None and model.env.num_envs == 1
        assert model.get_vec_normalize_env() is (env if isinstance(env, VecNormalize) else None)
        before = model.env
        model.learn(4, reset_num_timesteps=False)
        for wrong in (DummyVecEnv([other] * 2), CounterEnv(9)):
            with pytest.raises((AssertionError, ValueError)):
                model.env = wrong
            assert model.env is before


@each
@pytest.mark.parametrize(("size", "fits"), [(2, True), (1, True), (3, False)])
def test_noise_is_for_these_actions(algorithm, policy, replay, method, size, fits):
    model = make(algorithm, action_noise=NormalActionNoise(np.zeros(size), np.ones(size)), learning_starts=0)
    if fits:
        model.learn(3)
        return
    with pytest.raises(ValueError, match=r"action_noise gives 3 numbers, for 1 environment\(s\) with 2 actions each"):
        model.learn(3)
