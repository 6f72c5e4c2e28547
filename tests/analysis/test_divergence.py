"""The Jensen–Shannon divergence: closed forms and brute force."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import jensenshannon

from sb3_dreamer_urlb.analysis.divergence import jensen_shannon

LOGITS = st.lists(st.floats(-30, 30), min_size=4, max_size=4)


@given(LOGITS)
def test_equal_distributions_are_not_apart(logits):
    one = th.tensor(logits)
    assert jensen_shannon(one, one + 3.0).item() == pytest.approx(0.0, abs=1e-6)
    assert jensen_shannon(one, one).item() == 0.0


def test_disjoint_ones_are_ln_2_apart():
    one, other = th.tensor([[0.0, 0.0, -th.inf, -th.inf]]), th.tensor([[-th.inf, -th.inf, 1.0, 5.0]])
    assert jensen_shannon(one, other).item() == pytest.approx(math.log(2), abs=1e-12)
    sharp = jensen_shannon(th.tensor([400.0, 0.0]), th.tensor([0.0, 400.0])).item()
    assert sharp == pytest.approx(math.log(2), abs=1e-12)


def test_two_classes_by_hand():
    """p = (1, 0), q = (½, ½): m = (¾, ¼)."""
    found = jensen_shannon(th.tensor([0.0, -th.inf]), th.tensor([0.0, 0.0])).item()
    by_hand = 0.5 * math.log(4 / 3) + 0.5 * (0.5 * math.log(0.5 / 0.75) + 0.5 * math.log(0.5 / 0.25))
    assert found == pytest.approx(by_hand, abs=1e-12)


@given(LOGITS, LOGITS)
def test_symmetric_bounded_and_as_scipy_has_it(logits, others):
    one, other = th.tensor(logits, dtype=th.float64), th.tensor(others, dtype=th.float64)
    found = jensen_shannon(one, other).item()
    assert found == pytest.approx(jensen_shannon(other, one).item(), abs=1e-12)
    assert 0 <= found <= math.log(2) + 1e-12
    p, q = (np.exp(x - np.logaddexp.reduce(x)) for x in (one.numpy(), other.numpy()))
    assert found == pytest.approx(float(np.nan_to_num(jensenshannon(p, q))) ** 2, abs=1e-9)


def test_of_each_variable():
    logits, other = th.randn(5, 3, 4), th.randn(5, 3, 4)
    found = jensen_shannon(logits, other)
    assert found.shape == (5, 3)
    assert found[2, 1].item() == pytest.approx(jensen_shannon(logits[2, 1], other[2, 1]).item(), abs=1e-12)
