"""A guard against slow-downs that needs no clock: operator calls of one update and one planned action, at tiny size.

The bounds are the counts of today plus a tenth. Who needs more calls raises a bound in the same commit and says why; who
saves some lowers it. Counted with a TorchDispatchMode: everything below autograd, views included, forward and backward.
"""

from __future__ import annotations

import pytest
import torch as th
from operator_calls import Calls, never_waiting

from sb3_dreamer_urlb import native
from sb3_dreamer_urlb.native import product_ops
from sb3_dreamer_urlb.nn.precision import cpu_multiplies_short
from sb3_dreamer_urlb.planning import DynaMPC, PlannerConfig
from sb3_dreamer_urlb.planning.prepared.agent import planned

# Operator calls by what runs; T = 5 and H = 3 in an update, H = 3 and J = 2 in a plan.
# A plan on a CPU takes more and cheaper ones: its draws add up one class after the other, for all states at once.
BOUNDS = {
    ("update", None, "float32"): 1750,
    ("update", "lbs", "float32"): 1810,
    ("update", "lbs", "bfloat16"): 2140,
    ("plan", None, "float32"): 745,
    ("plan", None, "bfloat16"): 820,
    # Kernels of our own wherever there is one, as at full size; one lays weights out for each product.
    ("update", "lbs", "float32", "native"): 1770,
    ("update", "lbs", "bfloat16", "native"): 2040,
    ("plan", None, "float32", "native"): 355,
    ("plan", None, "bfloat16", "native"): 380,
}
#: operator calls of a plan whose bfloat16 products are float32 ones, where the processor has no others
CONVERSIONS = 130
PLANNER = PlannerConfig(horizon=3, n_samples=8, iterations=2, top_k=4, mixture=0.25)


@pytest.fixture
def work(learner, batch):
    """Make a function that does one update or plans one action."""

    def make(what, intrinsic, precision, compile="eager"):
        its = learner(intrinsic, precision=precision, compile=compile)
        if what == "update":
            return lambda: its.update(batch)
        state, planner = its.agent.world_model.rssm.initial(2), DynaMPC(PLANNER, 0.95)
        mean = th.zeros(2, PLANNER.horizon, its.agent.actor.action_size)

        def plan():
            with th.no_grad(), its._products(), native.using(compile, "cpu"):
                return planner.plan(planned(its.agent, th.zeros(2, 0)), state, mean, None, explore=True)

        return plan

    return make


@pytest.mark.parametrize("case", BOUNDS, ids=str)
def test_operator_calls_stay_below_their_bound(work, case, request):
    if "native" in case:
        request.getfixturevalue("kernels_of_every_size")
        if not product_ops.available():
            pytest.skip("this processor has no tiles (AMX)")
    run = work(*case)
    run()  # optimisers make their state
    with Calls() as calls:
        run()
    total = calls.counts.total()
    most = calls.counts.most_common(15)
    bound = BOUNDS[case]
    if case[0] == "plan" and case[2] == "bfloat16" and not cpu_multiplies_short():
        bound += CONVERSIONS
    assert total <= bound, f"{case}: {total} operator calls, the bound is {bound}: {most}"
    # A bound that nothing comes near guards nothing.
    assert total > 0.8 * BOUNDS[case], f"{case}: only {total} operator calls, lower the bound of {BOUNDS[case]}"


@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_planning_never_asks_the_device_for_a_value(work, monkeypatch, precision):
    plan = work("plan", None, precision)
    plan()  # anything that torch sets up once

    with never_waiting("planning"):
        action, mean = plan()
    assert action.shape == (2, 2) and mean.shape == (2, 3, 2)


@pytest.mark.parametrize("what", ["update", "plan"])
def test_one_more_operator_is_noticed(work, what):
    """The counter sees what it should: the forward and the backward pass, and each operator once."""
    x = th.ones(3, requires_grad=True)
    with Calls() as calls:
        (x * x).sum().backward()
    assert calls.counts["aten.mul.Tensor"] >= 2 and calls.counts["aten.sum.default"] == 1
    with Calls() as calls:
        work(what, None, "float32")()
    assert calls.counts.total() > 100
