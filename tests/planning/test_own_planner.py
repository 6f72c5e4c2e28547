"""Planners of users: by name, class or instance, saved by name and arguments, and never replaced without a word."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch as th
from fake_envs import CounterEnv
from gymnasium import spaces

from sb3_dreamer_urlb import DreamerPolicy, DreamerV2, Planner, PlannerConfig, SnapshotError, register_planner
from sb3_dreamer_urlb.evaluation.episodes import ON, run_evaluation
from sb3_dreamer_urlb.planning import CategoricalDynaMPC, DynaMPC, make_planner, planner_name, registered_planners, registry


@dataclass(frozen=True)
class OwnConfig(PlannerConfig):
    gain: float = 1.0


class Own(DynaMPC):
    config_class = OwnConfig
    asked = 0

    def elites(self, actions, value):
        type(self).asked += 1
        return super().elites(actions, self.config.gain * value)


class OwnChoices(CategoricalDynaMPC):
    config_class = OwnConfig


class Unregistered(DynaMPC):
    pass


class WithArguments(DynaMPC):
    def __init__(self, config, gae_lambda, classes=(), secret=None):
        super().__init__(config, gae_lambda, classes)


SMALL = {"horizon": 3, "n_samples": 8, "iterations": 2, "top_k": 4, "mixture": 0.25}


@pytest.fixture(autouse=True)
def registered(monkeypatch):
    """Under the name "own", for one test."""
    monkeypatch.setattr(registry, "_KINDS", dict(registry._KINDS))
    monkeypatch.setattr(registry, "PLANNERS", dict(registry.PLANNERS))
    register_planner("own", Own, for_choices=OwnChoices)
    register_planner("with arguments", WithArguments)


def instance():
    return Own(OwnConfig(**SMALL, gain=3.0), 0.9)


WAYS = {"name": ("own", {"gain": 3.0}), "class": (Own, {"gain": 3.0}), "instance": (instance(), None)}


def check_own(model, gae_lambda):
    planner = model.policy.planner
    assert type(planner) is Own and planner.config == OwnConfig(**SMALL, gain=3.0) and planner.gae_lambda == gae_lambda


@pytest.mark.parametrize("way", WAYS)
def test_it_plans_and_is_the_same_after_load_and_fine_tune(tiny_model, tmp_path, way):
    planner, kwargs = WAYS[way]
    gae_lambda = 0.9 if way == "instance" else 0.95
    model = tiny_model(CounterEnv(), planner=planner, planner_kwargs=kwargs, intrinsic_reward="lbs").learn(24)
    check_own(model, gae_lambda)
    model.save(tmp_path / "model")
    loaded = DreamerV2.load(tmp_path / "model", env=CounterEnv())
    loaded.fine_tune()
    check_own(loaded, gae_lambda)
    before = Own.asked
    loaded.learn(24)
    assert Own.asked > before
    assert planner_name(loaded.planner) == "own"
    assert run_evaluation(loaded, loaded.env, 1, planner=ON).planner == "own"
    loaded.policy.save(tmp_path / "policy")
    check_own(type("", (), {"policy": DreamerPolicy.load(tmp_path / "policy")}), gae_lambda)


def test_an_instance_is_copied(tiny_model):
    its = instance()
    assert tiny_model(planner=its).policy.planner is not its


def test_the_name_for_choices_too(tiny_model, tmp_path):
    env = CounterEnv(action_space=spaces.Discrete(3))
    model = tiny_model(env, planner="own", learning_starts=0, planner_delay=0)
    assert type(model.policy.planner) is OwnChoices
    model.predict(env.reset()[0])
    model.policy.save(tmp_path / "policy")
    loaded = DreamerPolicy.load(tmp_path / "policy").planner
    assert type(loaded) is OwnChoices and loaded.classes == (3,)
    with pytest.raises(ValueError, match=r"Own does not plan Discrete.*CategoricalDynaMPC"):
        tiny_model(env, planner=Own)
    with pytest.raises(ValueError, match=r"OwnChoices does not plan Box.*derive it from DynaMPC"):
        tiny_model(planner=OwnChoices)
    with pytest.raises(ValueError, match=r"classes \(\), the actions have \(3,\)"):
        tiny_model(env, planner=instance())


@pytest.mark.parametrize(
    "planner", [Unregistered, Unregistered(PlannerConfig(**SMALL), 0.95), WithArguments(PlannerConfig(), 0.9)]
)
def test_what_no_file_can_hold_must_be_given_again(tiny_model, tmp_path, planner):
    tiny_model(planner=planner).save(tmp_path / "model")
    with pytest.raises(SnapshotError, match=r"planner was .*(Unregistered|WithArguments).*custom_objects=\{'planner'"):
        DreamerV2.load(tmp_path / "model")
    for given in ({"custom_objects": {"planner": planner}}, {"planner": planner}):
        loaded = DreamerV2.load(tmp_path / "model", **given).policy.planner
        assert type(loaded) is (planner if isinstance(planner, type) else type(planner))


def test_the_class_of_an_object_that_no_file_can_hold_is_no_such_object(tiny_model, tmp_path):
    tiny_model(planner=Unregistered(PlannerConfig(**SMALL), 0.7)).save(tmp_path / "model")
    with pytest.raises(SnapshotError, match=r"its planner was an object of the class .*Unregistered, which no file can hold"):
        DreamerV2.load(tmp_path / "model")
    for given in ({"custom_objects": {"planner": Unregistered}}, {"planner": Unregistered}):
        with pytest.raises(SnapshotError, match=r"settings that no file can hold: give such an object, not the class"):
            DreamerV2.load(tmp_path / "model", **given)
    # Another class, or a name, is another planner, as asked for.
    assert type(DreamerV2.load(tmp_path / "model", planner=Own).policy.planner) is Own


@pytest.mark.parametrize("planner", ["own", Own, instance()])
def test_a_file_whose_planner_is_not_registered_here_is_refused(tiny_model, tmp_path, planner, monkeypatch):
    tiny_model(planner=planner).save(tmp_path / "model")
    monkeypatch.delitem(registry._KINDS, "own")
    said = r"its planner is 'own', which is not registered here; known are \[.*'dyna_mpc'.*'mppi'.*register_planner\('own'"
    with pytest.raises(SnapshotError, match=said + r'.*or another one: load\(\.\.\., planner="dyna_mpc"\)'):
        DreamerV2.load(tmp_path / "model")
    assert DreamerV2.load(tmp_path / "model", planner="dyna_mpc").planner == "dyna_mpc"


def test_another_planner_on_demand(tiny_model, tmp_path):
    tiny_model(planner="dyna_mpc").save(tmp_path / "model")
    check_own(DreamerV2.load(tmp_path / "model", planner=instance()), 0.9)
    assert DreamerV2.load(tmp_path / "model", planner="mppi").policy.planner.config.use_value is False
    assert DreamerV2.load(tmp_path / "model", planner=None).policy.planner is None


def test_by_hand_is_refused_with_the_right_way(tiny_model):
    policy = tiny_model(planner="dyna_mpc").policy
    before = policy.planner
    with pytest.raises(AttributeError, match=r"planner=\.\.\.\) or DreamerV2\.load\(path, planner="):
        policy.planner = instance()
    assert policy.planner is before


@pytest.mark.parametrize("name", ["config", "gae_lambda", "classes"])
def test_what_a_policy_plans_with_is_not_changed_by_hand(tiny_model, name):
    its = instance()
    model = tiny_model(planner=its)
    planner = model.policy.planner
    before, value = getattr(planner, name), getattr(planner, name)
    with pytest.raises(AttributeError, match=rf"The {name} of a policy's planner is not changed by hand.*planner_kwargs"):
        setattr(planner, name, value)
    assert getattr(planner, name) is before
    its.gae_lambda = 0.1  # the caller's own is another one
    model.planner = "dyna_mpc"
    model.planner_kwargs = {"n_samples": 9, "top_k": 2}
    assert model.learn(1).policy.planner.config.n_samples == 9


def test_a_name_settles_what_there_is():
    with pytest.raises(ValueError, match=r"Unknown settled \['gian'\] for OwnConfig; known are .*Did you mean 'gain'"):
        register_planner("settled", Own, settled={"gian": 1.0})
    assert "settled" not in registered_planners()


@pytest.mark.parametrize("planner", [3, object, "own ", Planner, ["own"]])
def test_anything_else_is_refused(tiny_model, planner):
    with pytest.raises((ValueError, TypeError), match=r"[Pp]lanner"):
        tiny_model(planner=planner)


def test_arguments_that_do_not_fit(tiny_model):
    with pytest.raises(ValueError, match=r"planner_kwargs=\{'gain': 2\} need the name or the class.*own"):
        make_planner(instance(), {"gain": 2}, 0.95)
    with pytest.raises(ValueError, match=r"Unknown planner_kwargs \['gian'\]; known are .*gain"):
        tiny_model(planner="own", planner_kwargs={"gian": 2})
    with pytest.raises(ValueError, match="Own needs a OwnConfig"):
        Own(PlannerConfig(), 0.9)


def test_a_name_means_one_thing():
    register_planner("own", Own, for_choices=OwnChoices)
    assert registered_planners()["own"] == (Own, OwnChoices)
    for planner, message in ((DynaMPC, "already Own"), (object, "subclass of Planner")):
        with pytest.raises(ValueError, match=message):
            register_planner("own", planner)
    with pytest.raises(ValueError, match="must be a text"):
        register_planner("", Own)


def test_it_sees_the_agent_and_its_memory_is_its_plan(tiny_model):
    """A planner from scratch: nothing of Dyna-MPC."""

    class Still(Planner):
        def plan(self, model, state, previous_mean, generator, explore):
            assert previous_mean.shape[1:] == (self.config.horizon, 2)
            return previous_mean[:, 0] * 0 + 0.5, previous_mean

    model = tiny_model(planner=Still, learning_starts=0, planner_delay=0)
    action, _ = model.predict(np.zeros((1, 16, 16, 3), np.uint8))
    assert np.allclose(action, 0.5)


@pytest.mark.parametrize(
    "space", [spaces.Box(-2, 1, (2,), np.float32), spaces.MultiDiscrete([2, 3])], ids=["numbers", "choices"]
)
def test_the_replay_holds_what_the_environment_got(space):
    class Far(Planner):
        plans_choices = True

        def plan(self, model, state, previous_mean, generator, explore):
            action = th.full_like(previous_mean[:, 0], -5.0)
            action[:, -1] = 5.0
            return action, previous_mean

    env = CounterEnv(6, action_space=space)
    model = DreamerV2("CnnPolicy", env, preset="tiny", planner=Far, learning_starts=1, planner_delay=0, device="cpu").learn(13)
    action, state = model.predict(env.reset()[0])
    expected, stored = ([-2, 1], [-1, 1]) if isinstance(space, spaces.Box) else ([0, 2], [1, 0, 0, 0, 1])
    assert action.tolist() == expected and state[2].tolist() == [stored]
    assert all(np.allclose(received, expected) for received in env.received[1])
    assert (model.replay_buffer.episodes[1].columns["action"][1:7] == np.float32(stored)).all()


@pytest.mark.parametrize("value", ["False", 1, None])
def test_the_switch_of_a_planner_is_one(tiny_model, value):
    with pytest.raises(ValueError, match="planner use_value must be True or False"):
        tiny_model(planner="dyna_mpc", planner_kwargs={"use_value": value})


def test_a_class_that_plans_nothing_is_named(tiny_model):
    with pytest.raises(ValueError, match="planner must be a class that plans, Planner lacks plan"):
        tiny_model(planner=Planner)


@pytest.mark.parametrize(
    ("method", "wrong", "said"),
    [
        ("evaluate", lambda value: value[:, 0], r"\(1, 10\), got \(1,\)"),
        ("evaluate", lambda value: value.unsqueeze(-1), r"\(1, 10\), got \(1, 10, 1\)"),
        ("evaluate", lambda value: value.tolist(), r"\(1, 10\), got list"),
        ("elites", lambda pair: (pair[0], pair[1][:, :2]), r"\(1, k, 3, 6\), \(1, k\), got \(1, 4, 3, 6\), \(1, 2\)"),
        ("elites", lambda pair: pair[0], r"\(1, k, 3, 6\), \(1, k\), got \(1, 4, 3, 6\)"),
        ("refine", lambda pair: pair[0], r"\(1, 3, 6\), \(1, 3, 6\), got \(1, 3, 6\)"),
        ("plan", lambda pair: (pair[0][:, :3], pair[1]), r"\(1, 6\), \(1, 3, 6\), got \(1, 3\), \(1, 3, 6\)"),
        ("plan", lambda pair: pair[0], r"\(1, 6\), \(1, 3, 6\), got \(1, 6\)"),
    ],
)
def test_what_a_method_returns_has_the_right_form(method, wrong, said, monkeypatch):
    right = getattr(DynaMPC, method)
    monkeypatch.setattr(Own, method, lambda self, *args, **kwargs: wrong(right(self, *args, **kwargs)))
    env = CounterEnv(20, action_space=spaces.Box(-1, 1, (6,), np.float32))
    model = DreamerV2("CnnPolicy", env, preset="tiny", planner=instance(), learning_starts=0, planner_delay=0, device="cpu")
    with pytest.raises(ValueError, match=rf"^Own\.{method} must return {said}\.$"):
        model.predict(env.reset()[0], deterministic=True)


def test_another_number_of_elites_is_right(monkeypatch):
    monkeypatch.setattr(Own, "elites", lambda self, *args: tuple(part[:, :2] for part in DynaMPC.elites(self, *args)))
    env = CounterEnv(20, action_space=spaces.Box(-1, 1, (6,), np.float32))
    model = DreamerV2("CnnPolicy", env, preset="tiny", planner=instance(), learning_starts=0, planner_delay=0, device="cpu")
    assert model.predict(env.reset()[0], deterministic=True)[0].shape == (6,)
