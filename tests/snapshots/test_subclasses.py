"""Subclasses are saved and loaded whatever their constructors look like; where they cannot be, saving says so."""

from __future__ import annotations

import io

import numpy as np
import pytest
from fake_envs import CounterEnv
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_dreamer_urlb import DreamerV2, DrQv2, SequenceReplayBuffer, SnapshotError
from sb3_dreamer_urlb.dreamer_v2.policies import MlpPolicy
from sb3_dreamer_urlb.drq_v2.policies import MlpPolicy as DrQMlpPolicy
from sb3_dreamer_urlb.hub.model_card import changed_arguments
from sb3_dreamer_urlb.replay.n_step import NStepFrameReplayBuffer

SPACE = spaces.Box(-1, 1, (3,), np.float32)
KINDS = [(DreamerV2, MlpPolicy, SequenceReplayBuffer, "icm"), (DrQv2, DrQMlpPolicy, NStepFrameReplayBuffer, "disagreement")]
each = pytest.mark.parametrize(("algorithm", "policy", "replay", "method"), KINDS, ids=["dreamer_v2", "drq_v2"])


def make_env():
    return CounterEnv(6, observation_space=SPACE)


def through_a_file(model, env=None, **kwargs):
    file = io.BytesIO()
    model.save(file)
    file.seek(0)
    return type(model).load(file, env, device="cpu", **kwargs)


#: where a constructor takes each argument, and what else it takes
CONSTRUCTORS = st.fixed_dictionaries(
    {
        "policy": st.sampled_from(["in front", "by name", "fixed"]),
        "env": st.sampled_from(["in front", "by name"]),
        "nameless": st.booleans(),
        "named": st.booleans(),
        "own": st.booleans(),
    }
)


def subclass(base, method, policy, env, nameless, named, own):
    """A class with a constructor of its own.

    :param base: an algorithm
    :param method: that it explores with
    :param policy: "in front", "by name", or "fixed", if it takes none
    :param env: "in front" or "by name"
    :param nameless: takes ``*args``
    :param named: takes ``**kwargs``; else what it does not name is fixed
    :param own: has an argument of its own, which it keeps
    """
    where = {"policy": policy, "env": env}
    front = [f"{name}=None" for name in where if where[name] == "in front"]
    by_name = [f"{name}=None" for name in where if where[name] == "by name"] + ["bonus=1"] * own
    star = ["*args"] if nameless else ["*"] if by_name else []
    taken = ["self", *front, *star, *by_name, *["**kwargs"] * named]
    rest = "**kwargs" if named else "preset='tiny', seed=0, intrinsic_reward=method"
    passed = ["self", "'MlpPolicy'" if policy == "fixed" else "policy or 'MlpPolicy'", "env", *["*args"] * nameless, rest]
    lines = [
        f"def __init__({', '.join(taken)}):",
        f"    base.__init__({', '.join(passed)})",
        *["    self.bonus = bonus"] * own,
    ]
    scope = {"base": base, "method": method}
    exec("\n".join(lines), scope)
    return type("Mine", (base,), {"__init__": scope["__init__"]})


@each
@settings(max_examples=12)
@given(constructor=CONSTRUCTORS)
def test_any_constructor_goes_through_a_file(algorithm, policy, replay, method, constructor):
    kind = subclass(algorithm, method, **constructor)
    more = {"preset": "tiny", "seed": 0, "intrinsic_reward": method} if constructor["named"] else {}
    model = kind(env=make_env(), **more, **({"bonus": 5} if constructor["own"] else {}))
    model.gamma, model.batch_size = 0.5, 3
    model.learn(14)
    again = through_a_file(model, make_env(), learning_rate=np.float32(1e-3))
    assert (again.gamma, again.batch_size, again.preset, again.seed) == (0.5, 3, "tiny", 0)
    assert again.learning_rate == pytest.approx(1e-3) and getattr(again, "bonus", 5) == 5
    assert again.policy_kwargs == model.policy_kwargs and again.num_timesteps == model.num_timesteps
    seen = SPACE.sample()
    assert np.array_equal(*(one.predict(seen, deterministic=True)[0] for one in (model, again)))
    again.fine_tune(make_env())
    again.learn(8)
    assert through_a_file(again).phase == "finetuning"


@each
def test_what_a_constructor_decides_can_be_changed_when_loading(algorithm, policy, replay, method):
    class Fixed(algorithm):
        def __init__(self, env, rate=1e-3):
            super().__init__("MlpPolicy", env, preset="tiny", learning_rate=rate, batch_size=3)

    with pytest.warns(UserWarning, match=r"Fixed has no attribute 'rate'.*To keep it: self\.rate = rate"):
        model = through_a_file(Fixed(make_env(), 1e-2), batch_size=7, policy_kwargs={}, seed=4)
    assert (model.learning_rate, model.batch_size, model.seed, model.device.type) == (1e-2, 7, 4, "cpu")
    assert changed_arguments(model)["batch_size"] == 7  # of its card on the Hub


@each
def test_what_cannot_be_made_anew_is_said_before_the_file_is_touched(algorithm, policy, replay, method, tmp_path):
    class Hides(algorithm):
        def __init__(self, settings, **kwargs):
            super().__init__("MlpPolicy", settings["env"], preset="tiny", **kwargs)

    class Looks(algorithm):
        def __init__(self, policy, env, **kwargs):
            super().__init__(policy, env, batch_size=env.observation_space.shape[0], preset="tiny", **kwargs)

    for model, reason in (
        (Hides({"env": make_env()}), "missing 1 required positional argument: 'settings'"),
        (Looks("MlpPolicy", make_env()), "'NoneType' object has no attribute 'observation_space'"),
    ):
        (tmp_path / "m.zip").write_bytes(b"old")
        with pytest.raises(ValueError, match=f"The model is not saved.* cannot be made as files are read.*{reason}"):
            model.save(tmp_path / "m")
        assert (tmp_path / "m.zip").read_bytes() == b"old"


@each
def test_parts_of_ones_own_may_want_their_arguments_by_name(algorithm, policy, replay, method):
    class ByName(policy):
        def __init__(self, *, observation_space, action_space, lr_schedule, mine=1, **kwargs):
            super().__init__(observation_space, action_space, lr_schedule, **kwargs)
            self.mine = mine

    class OtherNames(policy):
        def __init__(self, sees, does, rate, **kwargs):
            super().__init__(sees, does, rate, **kwargs)

    class Kept(replay):
        def __init__(self, *, buffer_size, observation_space, action_space, **kwargs):
            super().__init__(buffer_size, observation_space, action_space, **kwargs)

    for kind, kwargs in ((ByName, {"mine": 7}), (OtherNames, {})):
        model = algorithm(
            kind,
            make_env(),
            preset="tiny",
            device="cpu",
            replay_buffer_class=Kept,
            policy_kwargs=kwargs,
            intrinsic_reward=method,
        ).learn(14)
        with pytest.warns(UserWarning, match="No file can hold"):
            again = through_a_file(model, custom_objects={"policy_class": kind, "replay_buffer_class": Kept})
        assert type(again.policy) is kind and type(again.replay_buffer) is Kept
        again.fine_tune(make_env())
        assert again.learn(8).phase == "finetuning"
    file = io.BytesIO()
    by_name = algorithm(ByName, make_env(), preset="tiny", device="cpu", policy_kwargs={"mine": 7}).policy
    by_name.save(file)
    file.seek(0)
    assert ByName.load(file, device="cpu").mine == 7


@each
def test_a_file_with_arguments_of_a_class_of_ones_own_is_not_its_bases(algorithm, policy, replay, method):
    class Extended(algorithm):
        def __init__(self, *args, colour="red", **kwargs):
            self.colour = colour
            super().__init__(*args, **kwargs)

    file = io.BytesIO()
    Extended("MlpPolicy", make_env(), preset="tiny", device="cpu").save(file)
    file.seek(0)
    with pytest.raises(
        SnapshotError, match=r"argument 'colour', which .* has not: the load of the class that saved it reads it"
    ):
        algorithm.load(file)
