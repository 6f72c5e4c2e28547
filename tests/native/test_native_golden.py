"""The authors' numbers, and updates of both formats, with kernels of our own wherever there is one."""

from __future__ import annotations

import golden
import pytest
import torch as th
from golden import FILES, OTHERS, golden_path
from operator_calls import Calls

from sb3_dreamer_urlb.native import product_ops
from sb3_dreamer_urlb.nn import distributions

#: what runs: on every processor, with tiles, and what a plan adds to both
LEARNING = {"scale_images", "bias_elu_", "elu_backward", "squared_distance"}
LEARNING |= {"one_hot", "softmax_backward", "gates", "gates_backward"}
PRODUCTS = {"lay_out_weights", "rows_by_weights", "transposed_product", "image_gather", "image_scatter", "image_weight"}
PLANNING, CHAINS = {"gather"}, {"chain"}
#: largest error of a metric, and its size from which on that is meant relatively
ERROR = {"float32": 3e-5, "bfloat16": 0.04}
SMALLEST = 0.03


def _ours(calls):
    return {name.split(".")[1] for name in calls.counts if name.startswith("sb3_dreamer_urlb.")}


def _expected(plans):
    found = LEARNING | (PLANNING if plans else set())
    return found | PRODUCTS | (CHAINS if plans else set()) if product_ops.available() else found


@pytest.mark.parametrize("name", FILES + OTHERS)
def test_kernels_equal_the_authors_implementation(kernels_of_every_size, name):
    with Calls() as calls:
        worst = golden.check(golden_path(name), "native")
    assert worst.passed(), dict(worst.errors)
    assert _ours(calls) == _expected(name in FILES)


def test_golden_numbers_are_torchs_unless_asked_for(kernels_of_every_size):
    with Calls() as calls:
        golden.check(golden_path(FILES[0]))
    assert not _ours(calls)


def _any_class(logits, generator=None):
    return th.randint(logits.shape[-1], logits.shape[:-1])


@pytest.mark.parametrize("precision", ERROR)
@pytest.mark.parametrize("intrinsic", [None, "lbs", "plan2explore", "icm", "rnd", "apt"])
def test_losses_of_updates_agree(kernels_of_every_size, learner, batch, intrinsic, precision, monkeypatch):
    """A rounding of bfloat16 here or there changes a draw now and then, so classes are drawn regardless of it."""
    if precision == "bfloat16":
        monkeypatch.setattr(distributions, "draw_classes", _any_class)
        monkeypatch.setattr(
            distributions, "draw_classes_and_probs", lambda logits, _: (_any_class(logits), logits.float().softmax(-1))
        )
    found = {}
    for compile in ("eager", "native"):
        th.manual_seed(1)
        its = learner(intrinsic, compile=compile, precision=precision, discount_head=True)
        th.manual_seed(2)
        with Calls() as calls:
            metrics = [{name: value.item() for name, value in its.update(batch).items()} for _ in range(3)]
        found[compile] = metrics
        draws = {"draws"} if precision == "float32" else set()
        assert _ours(calls) == (_expected(False) | draws if compile == "native" else set())
    for ours, theirs in zip(found["native"], found["eager"], strict=True):
        assert ours.keys() == theirs.keys() and len(ours) > 10
        for name, value in theirs.items():
            assert abs(ours[name] - value) <= ERROR[precision] * max(abs(value), SMALLEST), (name, ours[name], value)
