"""Attributes of environments are read only if they mean here what their names say."""

from __future__ import annotations

import io
import warnings

import numpy as np
import pytest
from fake_envs import CounterEnv
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_dreamer_urlb import DreamerV2
from sb3_dreamer_urlb.envs.facts import FACTS, env_fact

OURS = {
    "action_repeat": [1, 2, np.int64(4)],
    "domain": ["jaco", "x"],
    "max_episode_steps": [9],
    "never_terminates": [True, np.False_],
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
