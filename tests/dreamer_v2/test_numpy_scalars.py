"""numpy's scalars count as Python's numbers wherever an argument is taken, and pass the same checks."""

from __future__ import annotations

import inspect

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_dreamer_urlb import DreamerV2, PhaseSwitchCallback
from sb3_dreamer_urlb.number_checks import plain

NUMBERS = {
    **{
        name: parameter.default
        for name, parameter in inspect.signature(DreamerV2.__init__).parameters.items()
        if isinstance(parameter.default, bool | int | float) and name not in ("_init_setup_model", "batch_length", "verbose")
    },
    "batch_length": 4,
    "ent_coef": 0.25,
    "seed": 3,
    "discount_head": True,
}


def numpy_of(value):
    kinds = {bool: [np.bool_], int: [np.int32, np.int64, np.uint16], float: [np.float32, np.float64]}[type(value)]
    return [kind(value) for kind in kinds if value < 2**15 or kind is not np.uint16] + [np.array(value)]


@pytest.mark.parametrize("name", NUMBERS)
def test_every_number_of_the_constructor(tiny_model, name):
    for value in numpy_of(NUMBERS[name]):
        found = tiny_model(**{name: value}, _init_setup_model=False).arguments()[name]
        assert found == value and type(found) is type(NUMBERS[name])


def test_a_model_of_numpys_numbers_learns_and_is_loaded(tiny_model, tmp_path):
    values = {name: numpy_of(value)[0] for name, value in NUMBERS.items() if name not in ("buffer_size", "learning_starts")}
    small = {"batch_size": np.int64(2), "imagination_horizon": np.int64(3), "train_freq": (np.int64(4), "step")}
    sizes = {"policy_kwargs": {"net_arch": [np.int64(8)]}, "planner_kwargs": {"horizon": np.int64(2)}}
    model = tiny_model(**{**values, **small, **sizes}, planner="dyna_mpc").learn(np.int64(40), log_interval=np.int64(1))
    model.save(tmp_path / "m")
    assert DreamerV2.load(tmp_path / "m").arguments().keys() == model.arguments().keys() and model._n_updates > 0


@pytest.mark.parametrize(
    ("name", "value"),
    [("seed", np.int64(-1)), ("gamma", np.float32("nan")), ("batch_size", np.float64(2)), ("overlap", np.int8(1))],
)
def test_the_same_checks(tiny_model, name, value):
    with pytest.raises(ValueError, match=name):
        tiny_model(**{name: value})


@pytest.mark.parametrize("kind", [np.int64, np.array])
def test_numbers_beside_the_constructor(tiny_model, kind):
    tiny_model().set_random_seed(kind(3))
    assert PhaseSwitchCallback(kind(7)).pretrain_frames == 7


@given(st.recursive(st.one_of(st.integers(0, 9), st.text(), st.none()), lambda x: st.lists(x) | st.dictionaries(st.text(), x)))
def test_what_is_plain_stays(value):
    assert plain(value) == value
