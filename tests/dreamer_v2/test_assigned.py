"""What a model says of its arguments is in force: assigning takes effect in the next update, or is refused."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from fake_envs import CounterEnv
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import NormalActionNoise, VectorizedActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_dreamer_urlb import DreamerV2
from sb3_dreamer_urlb.algorithm.assignable_arguments import same
from sb3_dreamer_urlb.dreamer_v2.arguments import ASSIGNABLE

#: another value for each, and where it is in force
VALUES = {
    "learning_rate": 2e-4,
    "actor_learning_rate": 1e-9,
    "critic_learning_rate": 0.0,
    "adam_eps": 1e-3,
    "max_grad_norm": 1.0,
    "weight_decay": 1e-3,
    "batch_size": 3,
    "imagination_horizon": 5,
    "gamma": 0.5,
    "gae_lambda": 0.5,
    "ent_coef": 0.25,
    "free_nats": 0.5,
    "kl_balance": 0.25,
    "kl_scale": 2.0,
    "target_update_interval": 7,
    "learning_starts": 12,
    "train_freq": 2,
    "gradient_steps": 2,
    "skill_selection_starts": 20,
    "planner": "mppi",
    "planner_kwargs": {"iterations": 1},
    "planner_delay": 3,
    "action_noise": NormalActionNoise([0.0, 0.0], [0.1, 0.1]),
    "overlap": False,
    "verbose": 0,
    "tensorboard_log": None,
}


def in_force(model):
    """What trains and plans, as far as it keeps numbers of its own."""
    config, optimizer = model.learner.config, model.learner.model_optimizer
    planner = model.policy.planner
    return {
        **{name: getattr(config, name) for name in VALUES if hasattr(config, name)},
        "optimizer": (optimizer.eps, optimizer.max_grad_norm, optimizer.weight_decay),
        "rates": [one.learning_rate for one in model.learner.optimizers().values()],
        "gamma": model.policy.agent.world_model.gamma,
        "planner": (type(planner).__name__, planner.config, planner.gae_lambda),
        "train_freq": model.train_freq,
    }


def test_the_values_are_all_there_are():
    assert VALUES.keys() == ASSIGNABLE


@pytest.mark.parametrize("name", sorted(ASSIGNABLE))
def test_an_assigned_model_is_one_that_was_made_so(tiny_model, tmp_path, name):
    value = VALUES[name]
    assigned, made = tiny_model(planner="dyna_mpc"), tiny_model(**{"planner": "dyna_mpc", name: value})
    if name == "planner_kwargs":
        value = made.planner_kwargs
    setattr(assigned, name, value)
    for model in (assigned, made):
        model.learn(24)
    assert in_force(assigned) == in_force(made)
    assigned.save(tmp_path / "m")
    assert in_force(DreamerV2.load(tmp_path / "m", device="cpu")) | {"rates": 0} == in_force(made) | {"rates": 0}


@pytest.mark.parametrize("name", sorted(set(DreamerV2.argument_names()) - ASSIGNABLE - {"stats_window_size"}))
def test_what_was_built_is_not_assigned(tiny_model, name):
    model = tiny_model()
    before = getattr(model, name)
    way = r"another model, DreamerV2\(\.\.\., " if name in DreamerV2.of_the_networks else r"load\(path, "
    with pytest.raises(AttributeError, match=rf"{name} cannot be assigned.*{way}{name}=\.\.\.\)"):
        setattr(model, name, before)
    assert getattr(model, name) is before


@pytest.mark.parametrize("how", ["assigned", "loaded"])
def test_a_planners_arguments_wait_for_it(tiny_model, tmp_path, how):
    model = tiny_model(planner_kwargs={"n_samples": 9}).learn(4)
    if how == "assigned":
        model.planner = "dyna_mpc"
        model.learn(4)
    else:
        model.save(tmp_path / "m")
        model = DreamerV2.load(tmp_path / "m", planner="dyna_mpc", device="cpu")
    assert model.policy.planner.config.n_samples == 9


@pytest.mark.parametrize("then", ["learn", "save", "predict", "get_parameters", "train"])
def test_what_is_changed_within_a_dictionary_is_assigned(tiny_model, tmp_path, then):
    model = tiny_model(planner="dyna_mpc", replay_buffer_kwargs={"sampling": "rows"})
    act = {
        "learn": lambda: model.learn(4),
        "save": lambda: model.save(tmp_path / "m"),
        "predict": lambda: model.predict(np.zeros((16, 16, 3), np.uint8)),
        "get_parameters": model.get_parameters,
        "train": lambda: model.train(1, 1),
    }[then]
    model.planner_kwargs["iterations"] = 7
    act()
    assert model.policy.planner.config.iterations == model.planner_kwargs["iterations"] == 7
    model.planner_kwargs["iterations"] = 0
    with pytest.raises(ValueError, match="iterations"):
        act()
    assert model.policy.planner.config.iterations == model.planner_kwargs["iterations"] == 7
    for name, key, value in (("policy_kwargs", "net_arch", [9]), ("replay_buffer_kwargs", "sampling", "episodes")):
        before = getattr(model, name)[key]
        getattr(model, name)[key] = value
        with pytest.raises(AttributeError, match=f"{name} cannot be assigned"):
            act()
        assert getattr(model, name)[key] == before
    act()


@given(st.recursive(st.one_of(st.integers(0, 3), st.text(max_size=1)), lambda x: st.lists(x) | st.dictionaries(st.text(), x)))
def test_equal_values_are_the_same(value):
    assert same(value, copy.deepcopy(value)) and not same(value, [value, value]) and not same({"a": value}, {"b": value})
    assert same({"a": np.arange(3)}, {"a": np.arange(3)}) and not same({"a": np.arange(3)}, {"a": np.arange(4)})


@pytest.mark.parametrize(("name", "value"), [("ent_coef", -1), ("gamma", "x"), ("batch_size", 0), ("learning_rate", None)])
def test_bad_values_leave_the_old_ones(tiny_model, name, value):
    model = tiny_model(planner="dyna_mpc")
    before, force = getattr(model, name), in_force(model)
    with pytest.raises(ValueError, match=name):
        setattr(model, name, value)
    assert getattr(model, name) == before and in_force(model) == force


# -- within a learn --------------------------------------------------------------------------------------------------------


class At(BaseCallback):
    """Does something to the model after so many steps."""

    def __init__(self, steps, then):
        super().__init__()
        self.steps, self.then = steps, then

    def _on_step(self):
        if self.num_timesteps == self.steps:
            self.then(self.model)
        return True


@pytest.mark.parametrize("overlap", [False, True])
@pytest.mark.parametrize("unit", ["step", "episode"])
@pytest.mark.parametrize("frequency", [2, 8])
def test_updates_come_as_often_as_was_assigned(tiny_model, overlap, unit, frequency):
    """Within a rollout of four steps of two environments, whose end comes first; each step that follows is learnt from."""
    n_envs, gradient_steps = (2, -1) if unit == "step" else (1, 1)
    env = DummyVecEnv([lambda: CounterEnv(8)] * n_envs)
    model = tiny_model(env, learning_starts=0, gradient_steps=gradient_steps, train_freq=4, overlap=overlap)
    model.learn(40 * n_envs)
    before = model._n_updates
    callback = At(42 * n_envs, lambda model: setattr(model, "train_freq", (frequency, unit)))
    model.learn(64 * n_envs, callback=callback, reset_num_timesteps=False)
    if unit == "step":
        assert model._n_updates - before == model.num_timesteps - 40 * n_envs
    else:
        # A rollout of four steps, then some of two or eight episodes, until 104 steps are done.
        assert model._n_updates - before == {2: 1 + 4, 8: 1 + 1}[frequency]


@pytest.mark.parametrize("n_envs", [2, 3])
def test_noise_that_was_assigned_is_of_the_action(tiny_model, n_envs):
    class First(NormalActionNoise):
        def __call__(self):
            return np.array([0.5, 0.0], np.float32)

    noise = First(np.zeros(2), np.zeros(2))
    model = tiny_model(DummyVecEnv([lambda: CounterEnv(8)] * n_envs))
    expected = [[0.5, 0.0]] * n_envs
    assert model._as_executed(np.zeros((n_envs, 2)), noise).tolist() == expected
    assert model._as_executed(np.zeros((n_envs, 2)), VectorizedActionNoise(noise, n_envs)).tolist() == expected
    with pytest.raises(ValueError, match="action_noise gives 3 numbers"):
        model._as_executed(np.zeros((n_envs, 2)), NormalActionNoise(np.zeros(3), np.zeros(3)))


# -- the parts of a model --------------------------------------------------------------------------------------------------


def test_a_policy_that_nothing_would_train_is_not_assigned(tiny_model):
    model, other = tiny_model(), tiny_model(seed=3)
    with pytest.raises(AttributeError, match=r"policy cannot be assigned.*load_state_dict"):
        model.policy = other.policy
    model.policy = model.policy
    model.policy.load_state_dict(other.policy.state_dict())
    before = model.policy.agent
    model.learn(40)
    assert model.learner.agent is model.policy.agent is before and model._n_updates > 0


def test_a_replay_of_another_phase_or_form_is_not_assigned(tiny_model):
    model = tiny_model(intrinsic_reward="lbs").learn(40)
    replay = model.replay_buffer
    model.fine_tune()
    with pytest.raises(ValueError, match="with phase='finetuning'; this one has phase='pretraining'"):
        model.replay_buffer = replay
    with pytest.raises(ValueError, match=r"with batch_length=.*; this one has batch_length=5"):
        model.replay_buffer = tiny_model(batch_length=5).replay_buffer
    twin = tiny_model().learn(40)
    model.replay_buffer = twin.replay_buffer
    assert model.replay_buffer is twin.replay_buffer
