"""Dyna-MPC on a toy model whose best action is known."""

from __future__ import annotations

import dataclasses

import pytest
import torch as th
from hypothesis import given
from hypothesis import strategies as st
from planning_forms import StepByStep

from sb3_dreamer_urlb.planning import PLANNERS, DynaMPC, PlannerConfig, make_planner
from sb3_dreamer_urlb.types import LatentState

A, H = 2, 5
TARGETS = th.tensor([[0.5, -0.3], [-0.7, 0.1], [0.0, 0.9], [-0.2, -0.8]])


class Toy(StepByStep):
    """A state remembers its target and the last action; its reward is minus their squared distance.

    :param proposal: action of the actor in every state, None for the target itself
    :param value_target: what the critic believes in; None for a critic without an opinion
    """

    def __init__(self, proposal=None, value_target=None):
        self.proposal, self.value_target = proposal, value_target
        self.actions: list[th.Tensor] = []

    def step(self, state, action, generator):
        self.actions.append(action)
        return LatentState(state.stoch, action)

    def rewards(self, feature):
        return -(feature[..., A:] - feature[..., :A]).square().sum(-1)

    def values(self, feature):
        if self.value_target is None:
            return feature.new_zeros(feature.shape[:-1])
        return -10 * (feature[..., A:] - self.value_target).square().sum(-1)

    def discounts(self, feature):
        return th.full_like(feature[..., 0], 0.99)

    def act(self, feature, generator):
        return feature[..., :A] if self.proposal is None else self.proposal.expand(*feature.shape[:-1], A)


def _state(targets=TARGETS):
    return LatentState(targets, th.zeros_like(targets))


def _plan(model, config, targets=TARGETS, previous=None, seed=0, explore=False):
    previous = th.zeros(len(targets), config.horizon, A) if previous is None else previous
    return DynaMPC(config, 0.95).plan(model, _state(targets), previous, th.Generator().manual_seed(seed), explore)


PRECISE = PlannerConfig(horizon=3, n_samples=1000, iterations=12, top_k=64, mixture=0.0, temperature=2.0, min_std=0.02)


def test_finds_each_environments_own_optimum():
    action, mean = _plan(Toy(), PRECISE)
    assert (action - TARGETS).abs().max() < 0.1
    # Actions of all steps but the last are seen by a reward.
    assert (mean[:, :-1] - TARGETS[:, None]).abs().max() < 0.2


def test_environments_do_not_influence_each_other(monkeypatch, seeded):
    """With the same noise, an environment's plan is the same alone as in company."""
    noise = th.randn(3, 1, 64, H, A)
    monkeypatch.setattr(DynaMPC, "_sampling_noise", lambda self, mean, _: noise.expand(-1, len(mean), -1, -1, -1))
    config = PlannerConfig(H, 64, 3, 8, 0.25, temperature=1e6)  # one elite takes all the weight: no draw
    previous = th.rand(4, H, A) - 0.5
    together = _plan(Toy(), config, previous=previous)
    for i in range(4):
        alone = _plan(Toy(), config, TARGETS[i : i + 1], previous[i : i + 1])
        for ours, theirs in zip(alone, together, strict=True):
            assert th.allclose(ours, theirs[i : i + 1], atol=1e-6)


def test_warm_start_is_the_last_mean_one_step_on(monkeypatch, seeded):
    monkeypatch.setattr(DynaMPC, "_sampling_noise", lambda self, mean, _: th.zeros(1, len(mean), 1, *mean.shape[1:]))
    model, previous = Toy(), th.rand(4, H, A) * 2 - 1
    action, mean = _plan(model, PlannerConfig(H, 1, 1, 1, 0.0), previous=previous)
    expected = th.cat([previous[:, 1:], th.zeros(4, 1, A)], 1)
    tried = [actions for actions in model.actions if len(actions)]  # there are no actor trajectories
    assert th.allclose(th.stack(tried, 1), expected)
    assert th.allclose(action, expected[:, 0]) and th.allclose(mean, expected, atol=1e-6)


def test_first_samples_come_from_standard_deviation_two_clamped_to_the_box():
    model = Toy()
    _plan(model, PlannerConfig(H, 4000, 1, 1, 0.0), TARGETS[:1])
    sampled = th.cat(model.actions)
    assert sampled.abs().max() == 1
    # P(|2ε| < 1) = 0.383
    assert (sampled.abs() < 1).float().mean().item() == pytest.approx(0.383, abs=0.01)


def test_refinement_formula(seeded):
    config = PlannerConfig(H, 16, 1, 6, 0.0, temperature=0.5, momentum=0.1, min_std=0.3)
    planner = DynaMPC(config, 0.95)
    actions, value, mean = th.rand(2, 16, H, A), th.randn(2, 16), th.rand(2, H, A)
    elites, weight = planner.elites(actions, value)
    new_mean, new_std = planner.refine(mean, elites, weight)
    for i in range(2):
        best = value[i].argsort(descending=True)[:6]
        rho = th.exp(0.5 * (value[i][best] - value[i].max()))
        rho = (rho / rho.sum())[:, None, None]
        mu = (rho * actions[i][best]).sum(0)
        sigma = (rho * (actions[i][best] - mu).square()).sum(0).sqrt()
        assert th.allclose(weight[i], rho.flatten(), atol=1e-6)
        assert th.allclose(new_mean[i], 0.1 * mean[i] + 0.9 * mu, atol=1e-6)
        assert th.allclose(new_std[i], sigma.clamp(0.3, 2), atol=1e-5)


def test_the_action_is_an_elites_first_not_the_mean(monkeypatch, seeded):
    elites = {}
    original = DynaMPC.elites

    def spy(self, actions, value):
        elites["actions"], elites["weight"] = original(self, actions, value)
        return elites["actions"], elites["weight"]

    monkeypatch.setattr(DynaMPC, "elites", spy)
    # Little noise, so that no two samples are clamped to the same corner.
    noise = 0.1 * th.randn(1, 1, 32, H, A)
    monkeypatch.setattr(DynaMPC, "_sampling_noise", lambda *_: noise)
    config = PlannerConfig(H, 32, 1, 4, 0.0, temperature=1e-3)
    chosen = set()
    for seed in range(40):
        action, mean = _plan(Toy(), config, TARGETS[:1], seed=seed)
        matches = (elites["actions"][0, :, 0] == action).all(-1)
        assert matches.sum() == 1 and not th.allclose(action, mean[:, 0])
        chosen.add(int(matches.nonzero()))
    assert chosen == {0, 1, 2, 3}  # all are drawn where weights are equal


@pytest.mark.parametrize("use_value", [True, False])
def test_a_perfect_actors_proposals_win(use_value):
    config = PlannerConfig(H, 16, 2, 1, 1.0, use_value=use_value)
    action, mean = _plan(Toy(), config)
    assert th.equal(action, TARGETS)
    assert th.allclose(mean[:, 0], TARGETS * 0.99, atol=1e-6)  # momentum 0.1, twice


def test_the_mixture_counts_proposals_which_are_imagined_once():
    model = Toy()
    config = PlannerConfig(H, 10, 3, 2, 0.29)
    _plan(model, config)
    assert config.actor_trajectories == 2
    rows = [len(actions) for actions in model.actions]
    assert rows == [4 * 2] * (H - 1) + [4 * 12] * (3 * H)


def test_without_proposals_the_actor_does_not_matter():
    misled = Toy(proposal=th.tensor([-1.0, 1.0]))
    for a, b in zip(_plan(misled, PRECISE), _plan(Toy(), PRECISE), strict=True):
        assert th.equal(a, b)


def test_use_value_decides_whether_the_critic_counts():
    elsewhere = th.tensor([0.2, 0.2])
    believer = dataclasses.replace(PRECISE, use_value=True)
    # The last action leads to state H, of which only the critic speaks.
    _, mean = _plan(Toy(value_target=elsewhere), believer)
    assert (mean[:, -1] - elsewhere).abs().max() < 0.1
    assert (mean[:, 0] - TARGETS).abs().max() < 0.1  # no value speaks of state 1
    sceptic = dataclasses.replace(PRECISE, use_value=False)
    for a, b in zip(_plan(Toy(value_target=elsewhere), sceptic), _plan(Toy(), sceptic), strict=True):
        assert th.equal(a, b)


def test_a_generator_makes_a_plan_repeatable_and_leaves_the_global_one_alone():
    before = th.get_rng_state()
    config = PlannerConfig(H, 32, 2, 8, 0.25)
    first, again, other = (_plan(Toy(), config, seed=seed, explore=True) for seed in (1, 1, 2))
    assert all(th.equal(a, b) for a, b in zip(first, again, strict=True))
    assert not th.equal(first[0], other[0]) and th.equal(before, th.get_rng_state())


@pytest.mark.parametrize("noise", [100.0, -100.0])
def test_actions_stay_in_the_box_also_when_exploring(monkeypatch, noise):
    monkeypatch.setattr(DynaMPC, "_exploration_noise", staticmethod(lambda action, _: th.full_like(action, noise)))
    config = PlannerConfig(H, 16, 1, 4, 0.25)
    assert th.equal(_plan(Toy(), config, explore=True)[0], th.full((4, A), noise / 100))
    assert _plan(Toy(), config, explore=False)[0].abs().max() <= 1


def test_exploration_scatters_around_the_elite():
    config = PlannerConfig(H, 16, 1, 1, 1.0, min_std=0.2)
    actions = th.stack([_plan(Toy(), config, th.zeros(1, A), seed=seed, explore=True)[0][0] for seed in range(400)])
    assert actions.mean(0).abs().max() < 0.05 and (actions.std(0) - 0.2).abs().max() < 0.03


def test_horizon_two_is_enough():
    action, _ = _plan(Toy(), dataclasses.replace(PRECISE, horizon=2))
    assert (action - TARGETS).abs().max() < 0.15


# -- configuration ---------------------------------------------------------------------------------------------------------

integers = st.one_of(st.integers(max_value=0), st.floats(), st.just("3"), st.none())
nan_or_infinite = st.sampled_from([float("nan"), float("inf"), float("-inf")])
WRONG = {
    "horizon": st.one_of(integers, st.just(1)),
    "n_samples": integers,
    "iterations": integers,
    "top_k": st.one_of(integers, st.just(600)),
    "mixture": st.one_of(st.floats(max_value=-1e-6), st.floats(min_value=1.000001), nan_or_infinite),
    "momentum": st.one_of(st.floats(max_value=-1e-6), st.floats(min_value=1), nan_or_infinite),
    "temperature": st.floats(max_value=0),
    "min_std": st.one_of(st.floats(max_value=0), st.floats(min_value=2.0001), nan_or_infinite),
}


@pytest.mark.parametrize("name", WRONG)
@given(data=st.data())
def test_out_of_range_is_refused_by_name(name, data):
    with pytest.raises(ValueError, match=f"planner {name} must"):
        PlannerConfig(**{name: data.draw(WRONG[name])})


@pytest.mark.parametrize(
    "fields", [{"temperature": float("nan")}, {"temperature": float("inf")}, {"temperature": "1"}, {"mixture": "0.5"}]
)
def test_numbers_that_are_none_are_refused(fields):
    with pytest.raises(ValueError, match="planner"):
        PlannerConfig(**fields)


def test_the_papers_planner():
    config = make_planner("dyna_mpc", None, 0.95).config
    assert config == PlannerConfig(5, 512, 12, 64, 0.05, 0.5, 0.1, 0.1, True) and config.actor_trajectories == 25
    zero_shot = make_planner("mppi_zero_shot", {"horizon": 3, "iterations": 2}, 0.95).config
    numbers = (zero_shot.n_samples, zero_shot.top_k, zero_shot.horizon, zero_shot.actor_trajectories, zero_shot.use_value)
    assert numbers == (1000, 100, 15, 0, False) and zero_shot.iterations == 2
    mppi = make_planner("mppi", {"horizon": 15}, 0.95).config
    assert (mppi.use_value, mppi.mixture, mppi.horizon) == (False, 0.0, 15)
    assert make_planner(None, None, 0.95) is None


def test_unknown_planner_or_field_is_refused_with_what_there_is():
    with pytest.raises(ValueError, match=r"'cem'.*dyna_mpc.*mppi"):
        make_planner("cem", None, 0.95)
    for name in PLANNERS:
        with pytest.raises(ValueError, match=r"\['elites'\].*top_k"):
            make_planner(name, {"elites": 3}, 0.95)
