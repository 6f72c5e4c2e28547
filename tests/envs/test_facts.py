"""Attributes of environments are read only if they mean here what their names say."""

from __future__ import annotations

import io
import threading
import warnings

import gymnasium
import numpy as np
import pytest
from fake_envs import CounterEnv
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv

from sb3_dreamer_urlb import DreamerV2
from sb3_dreamer_urlb.envs import SupervisedVecEnv
from sb3_dreamer_urlb.envs.facts import FACTS, env_attribute, env_fact, steps_an_episode

OURS = {
    "action_repeat": [1, 2, np.int64(4)],
    "domain": ["jaco", "x"],
    "max_episode_steps": [9],
    "never_terminates": [True, np.False_],
    "reward_free": [True, np.False_],
    "task": ["run", "x"],
}
FOREIGN = st.one_of(
    st.tuples(st.floats(), st.floats()),
    st.floats(),
    st.builds(object),
    st.just(np.zeros(2)),
    st.just(int),
    st.integers(max_value=0),
)


def vec_env(**attributes):
    return DummyVecEnv([lambda: CounterEnv(20, **attributes)])


@given(st.data(), st.sampled_from(sorted(FACTS)))
def test_only_what_has_our_meaning(data, name):
    value = data.draw(st.one_of(FOREIGN, st.sampled_from(OURS[name]), st.none()))
    env, default = vec_env(**{name: value}), "default"
    if value is None:
        assert env_fact(env, name, default) == default
    elif any(value is own for own in OURS[name]):
        found = env_fact(env, name, default)
        assert found == value and not isinstance(found, np.generic)
    else:
        with pytest.warns(UserWarning, match=f"attribute {name} is .* it is not read"):
            assert env_fact(env, name, default) == default


def test_nothing_there_is_no_warning():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert [env_fact(vec_env(), name, None) for name in FACTS] == [None] * len(FACTS)


@pytest.mark.filterwarnings("ignore:The environment's attribute")
@pytest.mark.parametrize("value", [(0.5, 1.5), object(), 3.5, {"a": 1}])
def test_a_model_in_such_an_environment_is_saved_and_loaded(tiny_model, value):
    model = tiny_model(CounterEnv(**dict.fromkeys(FACTS, value)))
    file = io.BytesIO()
    model.save(file)
    file.seek(0)
    again = DreamerV2.load(file, device="cpu")
    assert (again.domain, again.action_repeat, again.discount_head) == (None, 1, True)


class Raises(CounterEnv):
    """Its properties want a reset first, its spec holds a function."""

    @property
    def domain(self):
        raise RuntimeError("reset first")

    @property
    def max_episode_steps(self):
        return {}["steps"]


class Shy:
    def __repr__(self):
        raise ValueError


def test_a_value_without_a_text_is_called_by_its_class():
    env = CounterEnv()
    env.domain = Shy()
    with pytest.warns(UserWarning, match="an object of the class Shy"):
        assert env_fact(DummyVecEnv([lambda: env]), "domain", None) is None


def unspeakable():
    env = Raises(20, task=threading.Lock())
    env.spec = gymnasium.envs.registration.EnvSpec("OfAFunction-v0", entry_point=lambda: None)
    return Monitor(env)


WAYS = {
    "here": DummyVecEnv,
    "SubprocVecEnv": lambda fns: SubprocVecEnv(fns, start_method="forkserver"),
    "SupervisedVecEnv": SupervisedVecEnv,
}


@pytest.mark.parametrize("way", WAYS)
def test_what_raises_or_cannot_be_sent_is_not_read_and_ends_no_process(way):
    env = WAYS[way]([unspeakable])
    try:
        for name, text in (("domain", "a property that raises RuntimeError: reset first"), ("task", "lock object")):
            with pytest.warns(UserWarning, match=f"attribute {name} is .*{text}.* it is not read"):
                assert env_fact(env, name, None) is None
        assert steps_an_episode(env) is None
        assert env_attribute(env, "metadata", {})["render_fps"] == 20
        assert (env_attribute(env, "spec", None) is None) == (way != "here")
        env.reset()
    finally:
        env.close()


def bare():
    return Raises()


def test_a_process_that_ends_by_a_question_is_explained():
    env = SubprocVecEnv([bare], start_method="forkserver")
    with pytest.raises(RuntimeError, match=r"ended when it was asked for the attribute 'domain'.*Monitor"):
        env_fact(env, "domain", None)
    env.processes[0].join(10)


def test_an_answer_that_cannot_be_sent_is_an_error_and_ends_no_process():
    env = SupervisedVecEnv([unspeakable])
    try:
        with pytest.raises(TypeError, match="pickle"):
            env.get_attr("task")
        env.reset()
    finally:
        env.close()
