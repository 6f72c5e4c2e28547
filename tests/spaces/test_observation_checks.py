"""Choices that a space does not have are refused, whoever hands them in; those that it has, pass."""

from __future__ import annotations

import numpy as np
import pytest
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from sb3_dreamer_urlb.spaces.observation_checks import check_classes, checked_observation

SPACES = (
    spaces.Discrete(4),
    spaces.Discrete(3, start=-1),
    spaces.MultiDiscrete([2, 5]),
    spaces.MultiDiscrete([3, 2], start=[1, -2]),
    spaces.MultiBinary(3),
    spaces.MultiBinary((2, 2)),
)


def bounds(space):
    if isinstance(space, spaces.MultiBinary):
        return np.zeros(space.shape), np.ones(space.shape)
    counts = space.n if isinstance(space, spaces.Discrete) else space.nvec
    return np.asarray(space.start), np.asarray(space.start + counts - 1)


@given(
    space=st.sampled_from(SPACES),
    lead=st.integers(0, 3),
    kind=st.sampled_from([np.int64, np.float32]),
    seed=st.integers(0, 99),
)
def test_what_a_space_has_passes(space, lead, kind, seed):
    space.seed(seed)
    value = np.stack([space.sample() for _ in range(lead)]) if lead else np.asarray(space.sample())
    assert np.array_equal(checked_observation(value.astype(kind), space), value)


@given(
    space=st.sampled_from(SPACES),
    wrong=st.sampled_from(["below", "above", "between"]),
    where=st.integers(0, 7),
    by_name=st.booleans(),
    data=st.data(),
)
def test_what_it_has_not_is_refused(space, wrong, where, by_name, data):
    space.seed(0)
    low, high = bounds(space)
    value = np.stack([space.sample(), space.sample()]).astype(np.float64)
    place = where % value.size
    part = place % max(low.size, 1)
    least, most = low.reshape(-1)[part], high.reshape(-1)[part]
    value.reshape(-1)[place] = {"below": least - 1, "above": most + data.draw(st.integers(1, 300)), "between": least + 0.5}[
        wrong
    ]
    if by_name:
        space, value = spaces.Dict({"part": space}), {"part": value}
    with pytest.raises(ValueError, match=r"must be in (Multi)?(Discrete|Binary)\(.*, got "):
        checked_observation(value, space)
    with pytest.raises(ValueError, match=r"The environments' observation.* must be in"):
        check_classes("The environments' observation", value, space)
