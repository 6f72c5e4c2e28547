"""What is near a name that nobody knows."""

from __future__ import annotations

import string

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sb3_dreamer_urlb.unknown_names import NEAREST, UnknownNameError, check_keys, did_you_mean, nearest, unexpected_arguments

NAMES = st.text(string.ascii_letters + "_", min_size=3, max_size=20)


@given(st.lists(NAMES, min_size=1, max_size=40, unique_by=str.lower), st.data())
def test_a_name_in_another_case_or_with_a_letter_too_many_is_near(known, data):
    meant = data.draw(st.sampled_from(known))
    assert nearest(meant.upper(), known) == [meant]
    assert nearest(f"{meant}s", known)
    assert set(nearest(meant, known)) <= set(known) and len(nearest(meant, known)) <= NEAREST


def test_part_of_a_name_is_near_but_not_two_letters_of_it():
    known = ["imagination_horizon", "planner", "learning_rate"]
    assert nearest("horizon", known) == ["imagination_horizon"]
    assert nearest("in", known) == [] and did_you_mean(["in"], known) == ""


def test_several_names_are_asked_for_at_once():
    error = unexpected_arguments("f", ["planer", "gama"], ["planner", "gamma", "seed"], "help(f)")
    assert str(error) == (
        "f: got unexpected keyword arguments 'planer', 'gama'. Did you mean 'planner' or 'gamma'? help(f) lists all."
    )


def test_keys_that_there_are_pass_and_others_need_not_be_texts():
    check_keys("kwargs", {"k": 1}, ["k"])
    with pytest.raises(UnknownNameError, match=r"Unknown kwargs \['3', 'q'\] for 'apt'; known are \['k'\]\.$"):
        check_keys("kwargs", {3: 1, "q": 2}, ["k"], of="'apt'")
