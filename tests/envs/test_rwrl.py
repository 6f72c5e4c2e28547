"""Perturbed tasks as a user meets them: ids, any subset on any task, seeds, buffers across episodes, wrong numbers."""

from __future__ import annotations

import dataclasses
import functools
import math
from decimal import Decimal
from fractions import Fraction

import gymnasium
import numpy as np
import pytest
from gymnasium.error import ClosedEnvironmentError, ResetNeeded
from hypothesis import given, settings
from hypothesis import strategies as st
from without_display import run

from sb3_dreamer_urlb.envs import (
    Perturbations,
    PerturbationWrapper,
    make_dmc_env,
    make_rwrl_env,
    make_urlb_env,
    perturbations,
)
from sb3_dreamer_urlb.envs.perturbed_control import Delay

LEVELS = [(domain, level) for domain in ("walker", "quadruped") for level in perturbations.LEVELS]
make_states = functools.partial(make_urlb_env, observation="state")


def rewards(env, steps, seed=None, reset=True, action=0.5):
    """Of one action, again and again."""
    if reset:
        env.reset(seed=seed)
    return [env.step(np.full(env.action_space.shape, action, np.float32))[1] for _ in range(steps)]


@pytest.mark.parametrize(("domain", "level"), LEVELS)
def test_facts_of_the_ids(domain, level):
    env = gymnasium.make(f"rwrl/{domain}-walk-{level}-v0", observation="state")
    assert isinstance(env.spec.entry_point, str)
    for name, value in {"domain": domain, "task": "walk", "action_repeat": 2, "never_terminates": True}.items():
        assert env.get_wrapper_attr(name) == value
    assert env.get_wrapper_attr("max_episode_steps") == 500


def test_what_other_ids_tell_is_named():
    with pytest.raises(
        ValueError, match="domain_rewards=True: ids of the Real-World RL suite do not tell them; urlb/walker-walk"
    ):
        make_rwrl_env("walker", "walk", "hard", domain_rewards=True, observation="state")
    make_rwrl_env("walker", "walk", "hard", domain_rewards=False, observation="state").close()


def test_pictures_of_a_body_that_changes():
    env = make_rwrl_env("walker", "walk", "hard", fast_render=True)
    frames = [env.reset(seed=0)[0], env.reset()[0]]
    assert frames[0].std() > 10 and not np.array_equal(*frames)
    env.close()


def test_the_levels_are_the_papers():
    for level, (action, reward, held, noise, thigh, shin) in {
        "easy": (3, 10, 1, 0.1, (0.225, 0.25), (0.25, 0.3)),
        "medium": (6, 20, 2, 0.3, (0.225, 0.4), (0.25, 0.8)),
        "hard": (9, 40, 3, 1.0, (0.225, 0.55), (0.25, 1.4)),
    }.items():
        common = {"action_delay": action, "reward_delay": reward, "action_repetition": held, "action_noise": noise}
        assert perturbations.level("walker", level) == Perturbations(**common, thigh_length=thigh)
        assert perturbations.level("quadruped", level) == Perturbations(**common, shin_length=shin)
    # The paper's table and the suite's code differ in one number.
    assert perturbations.level("walker", "hard", hard_thigh="paper").thigh_length == (0.15, 0.55)
    env = gymnasium.make("rwrl/walker-walk-hard-v0", observation="state", hard_thigh="paper")
    assert env.unwrapped.perturbed.perturbations.thigh_length == (0.15, 0.55)


@settings(max_examples=50, deadline=None)
@given(steps=st.integers(0, 12), items=st.lists(st.integers(), min_size=1, max_size=30))
def test_a_delay_gives_back_what_came_before(steps, items):
    delay = Delay(steps)
    assert [delay(item) for item in items] == [items[max(0, t - steps)] for t in range(len(items))]


@settings(max_examples=10, deadline=None)
@given(delay=st.integers(1, 6), repeat=st.integers(1, 3), domain=st.sampled_from(["walker", "quadruped", "jaco"]))
def test_rewards_are_those_of_some_control_steps_before(delay, repeat, domain):
    task = {"walker": "stand", "quadruped": "jump", "jaco": "reach_top_left"}[domain]
    plain = rewards(make_states(domain, task, action_repeat=1), 12, seed=1)
    late = make_states(domain, task, action_repeat=repeat, perturbations={"reward_delay": delay})
    shifted = [plain[max(0, t - delay)] for t in range(12)]
    expected = [sum(shifted[t : t + repeat]) for t in range(0, 12, repeat)]
    np.testing.assert_allclose(rewards(late, 12 // repeat, seed=1), expected, rtol=1e-9)


def test_actions_are_executed_later_held_and_noisy():
    def executed(**wanted):
        env = make_states("walker", "walk", action_repeat=1, perturbations=wanted)
        env.reset(seed=2)
        done = []
        control_step = env._control.step
        env._control.step = lambda action: (done.append(action.copy()), control_step(action))[1]
        for t in range(8):
            env.step(np.full(6, t / 10, np.float32))
        return np.array(done)

    given_ = np.repeat(np.float32(np.arange(8) / 10)[:, None], 6, 1)
    np.testing.assert_allclose(executed(), given_, atol=1e-7)
    np.testing.assert_allclose(executed(action_delay=2), given_[[0, 0, 0, 1, 2, 3, 4, 5]], atol=1e-7)
    np.testing.assert_allclose(executed(action_repetition=3), given_[[0, 0, 0, 3, 3, 3, 6, 6]], atol=1e-7)
    np.testing.assert_allclose(executed(action_repetition=3, repetition_probability=0.0), given_, atol=1e-7)
    both = executed(action_delay=1, action_repetition=2)
    np.testing.assert_allclose(both, given_[[0, 0, 1, 1, 3, 3, 5, 5]], atol=1e-7)
    noisy = executed(action_noise=0.5)
    assert np.abs(noisy).max() == 1.0 and 0.1 < np.abs(noisy - given_).mean() < 0.6  # clipped to the task's bounds
    np.testing.assert_array_equal(noisy, executed(action_noise=0.5))


@pytest.mark.parametrize(
    ("domain", "task"), [("walker", "flip"), ("walker", "run"), ("quadruped", "jump"), ("quadruped", "run")]
)
def test_limbs_of_any_task_and_their_first_length(domain, task):
    """At the model's own length nothing changes; at another, the mass and the rewards do. A range is drawn from anew."""
    limb, own = ("thigh_length", 0.225) if domain == "walker" else ("shin_length", 0.25)
    plain = make_states(domain, task)
    expected = rewards(plain, 10, seed=3)
    same = make_states(domain, task, perturbations={limb: own})
    np.testing.assert_allclose(rewards(same, 10, seed=3), expected, rtol=1e-9)
    assert type(same._control.physics) is type(plain._control.physics)
    longer = make_states(domain, task, perturbations={limb: own * 1.3})
    assert not np.allclose(rewards(longer, 10, seed=3), expected, rtol=1e-3)
    drawn = make_states(domain, task, perturbations={limb: (own, own * 1.5)})
    lengths, masses = [], []
    for seed in (3, None, None):
        drawn.reset(seed=seed)
        lengths.append(drawn.perturbed.length)
        masses.append(drawn._control.physics.model.body_mass.sum())
    assert len(set(lengths)) == 3 and all(own <= length <= own * 1.5 for length in lengths)
    assert np.array_equal(np.argsort(masses), np.argsort(lengths))


@pytest.mark.parametrize("observation", ["pixels", "state", "both"])
def test_everything_random_comes_from_the_seed(observation):
    """Also in the same environment, whose buffers a seed empties."""

    def episodes(env, seed):
        env._picture = lambda size: np.zeros((size, size, 3), np.uint8)
        return [rewards(env, 15, seed), rewards(env, 15)]

    np.random.seed(0)  # noqa: NPY002
    one = make_rwrl_env("walker", level="medium", observation=observation)
    first = episodes(one, 7)
    again = episodes(one, 7)
    np.random.seed(1)  # noqa: NPY002 - NumPy's own stream is not asked
    other = episodes(make_rwrl_env("walker", level="medium", observation=observation), 7)
    assert first == again == other
    assert first != episodes(one, 8)
    unseeded = make_rwrl_env("walker", level="medium", observation=observation)
    assert first != episodes(unseeded, None)


def test_buffers_survive_a_reset_as_in_the_suite_or_are_emptied():
    kept = make_states("walker", "walk", action_repeat=1, perturbations={"reward_delay": 4})
    plain = rewards(make_states("walker", "walk", action_repeat=1), 10, seed=5)
    np.testing.assert_allclose(rewards(kept, 10, seed=5)[5:], plain[1:6])
    np.testing.assert_allclose(rewards(kept, 4), plain[-4:])  # the last episode's last rewards
    emptied = make_states("walker", "walk", action_repeat=1, perturbations={"reward_delay": 4, "keep_buffers": False})
    rewards(emptied, 10, seed=5)
    fresh = rewards(emptied, 4)
    assert len(set(fresh)) == 1 and fresh[0] not in plain


def test_one_wrapper_for_any_subset_on_any_task():
    wrapped = PerturbationWrapper(gymnasium.make("urlb/walker-run-v0", observation="state"), action_delay=3, action_noise=0.2)
    built = make_states("walker", "run", perturbations={"action_delay": 3, "action_noise": 0.2})
    assert rewards(wrapped, 8, seed=1) == rewards(built, 8, seed=1) != rewards(make_states("walker", "run"), 8, seed=1)
    ready = PerturbationWrapper(make_dmc_env("cartpole", "swingup", observation="state"), Perturbations(reward_delay=2))
    assert ready.unwrapped.perturbed.perturbations.reward_delay == 2
    with pytest.raises(ValueError, match="only the tasks of this package"):
        PerturbationWrapper(gymnasium.make("CartPole-v1"), action_delay=1)
    with pytest.raises(ValueError, match=r"perturbed already, by Perturbations\(action_delay=3"):
        PerturbationWrapper(wrapped, action_delay=1)
    with pytest.raises(ValueError, match="perturbations and action_delay were given"):
        PerturbationWrapper(built, Perturbations(), action_delay=1)


def test_an_episode_that_is_running_is_over_when_it_is_perturbed():
    env = gymnasium.make("urlb/walker-run-v0", observation="state")
    env.reset(seed=0)
    action = np.zeros(6, np.float32)
    env.step(action)
    wrapped = PerturbationWrapper(env, reward_delay=3, thigh_length=0.5)
    for one in (wrapped, env):
        with pytest.raises(ResetNeeded, match="walker-run"):
            one.step(action)
    fresh = make_states("walker", "run", perturbations={"reward_delay": 3, "thigh_length": 0.5})
    assert rewards(wrapped, 5, seed=1) == rewards(fresh, 5, seed=1)


def test_what_is_closed_cannot_be_perturbed():
    env = gymnasium.make("urlb/walker-run-v0", observation="state")
    env.close()
    with pytest.raises(ClosedEnvironmentError, match=r"walker-run.* was closed"):
        PerturbationWrapper(env, action_delay=1)


def test_a_wrapped_environment_is_made_again_from_its_spec():
    wrapped = PerturbationWrapper(
        gymnasium.make("urlb/walker-run-v0", observation="state"), reward_delay=3, thigh_length=(0.3, 0.4)
    )
    written = gymnasium.envs.registration.EnvSpec.from_json(wrapped.spec.to_json())
    for spec in (wrapped.spec, written):
        again = gymnasium.make(spec)
        assert again.unwrapped.perturbed.perturbations == wrapped.unwrapped.perturbed.perturbations
        assert rewards(again, 5, seed=1) == rewards(wrapped, 5, seed=1)


def test_what_is_perturbed_already_says_so():
    for make in (
        functools.partial(gymnasium.make, "rwrl/walker-walk-hard-v0"),
        functools.partial(make_rwrl_env, "walker", "walk", "hard"),
    ):
        with pytest.raises(
            ValueError, match=r"perturbations=.*walker-walk is perturbed already, by its level hard; .*urlb/walker-walk-v0"
        ):
            make(perturbations={"action_delay": 1}, observation="state")


@settings(max_examples=40, deadline=None)
@given(
    name=st.sampled_from(["action_noise", "repetition_probability", "thigh_length", "shin_length"]),
    bad=st.one_of(st.just(math.nan), st.just(math.inf), st.floats(-10, -1e-6), st.just("much"), st.just(True)),
)
def test_numbers_that_mean_nothing_are_named(name, bad):
    with pytest.raises(ValueError, match=f"{name}="):
        Perturbations(**{name: bad})


#: of every kind: what is neither a length, nor a delay, nor a probability, nor a standard deviation, nor True or False
HUGE = 10**400
NOTHING = [
    "x",
    b"x",
    [],
    (),
    {},
    [1, 2, 3],
    ("a", "b"),
    (1, math.nan),
    object(),
    1j,
    -(10**400),
    HUGE,
    -1,
    np.float64("nan"),
]
NOTHING += [np.array(["a"]), np.array([[1.0, 2.0]]), np.int64(-3), slice(3), Decimal("0.3"), math.inf]


@pytest.mark.parametrize("name", [field.name for field in dataclasses.fields(Perturbations)])
def test_values_of_any_kind_are_refused_by_name(name):
    for bad in NOTHING:
        if bad is HUGE and name in ("action_delay", "reward_delay", "action_repetition"):
            continue  # for ever
        with pytest.raises(ValueError, match=f"^{name}=") as caught:
            Perturbations(**{name: bad})
        assert ": expected " in str(caught.value)


def test_numbers_of_numpy_are_numbers():
    given_ = Perturbations(
        np.int64(3), np.uint8(2), np.int32(1), np.float32(0.5), np.array(0.25), np.array([0.25, 0.5]), None, np.True_
    )
    assert given_ == Perturbations(3, 2, 1, 0.5, 0.25, (0.25, 0.5), None, True)
    assert all(type(value) in (int, float, tuple, bool, type(None)) for value in dataclasses.astuple(given_))
    assert Perturbations(thigh_length=Fraction(1, 4)).thigh_length == 0.25 and type(given_.thigh_length[0]) is float


def test_a_delay_longer_than_any_episode_keeps_what_came_first():
    late = make_states("walker", "walk", perturbations={"reward_delay": 10**30, "action_delay": 10**12})
    assert len(set(rewards(late, 5, seed=0))) == 1


def test_shins_too_short_to_begin_with_are_named():
    short = make_states("quadruped", "walk", perturbations={"shin_length": 0.05})
    with pytest.raises(RuntimeError, match=r"shin_length=0.05: quadruped-walk cannot begin: Failed to find"):
        short.reset(seed=0)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"thigh_length": 0.001}, r"thigh_length=0.001: expected metres, 0.01 to 10, or a range of them"),
        ({"shin_length": (0.2, 1e12)}, r"shin_length=\(0.2, 1000000000000.0\): expected a range \(least, most\) of metres"),
        ({"action_delay": -1}, "action_delay=-1: expected an int of at least 0"),
        ({"reward_delay": 1.5}, "reward_delay=1.5"),
        ({"action_repetition": 0}, "action_repetition=0: expected None or an int of at least 1"),
        ({"repetition_probability": 1.1}, "repetition_probability=1.1: expected a number from 0 to 1"),
        ({"thigh_length": (0.4, 0.2)}, r"thigh_length=\(0.4, 0.2\): expected a range \(least, most\)"),
        ({"thigh_length": (0.1, 0.2, 0.3)}, "thigh_length="),
        ({"thigh_length": 0}, "thigh_length=0"),
        ({"repetition_probability": 0.5}, "repetition_probability=0.5: expected action_repetition with it"),
        ({"keep_buffers": "yes"}, "keep_buffers='yes': expected True or False"),
        ({"action_dealy": 1}, "unknown perturbation action_dealy: known are action_delay, .*shin_length"),
        ({"shin_length": 0.3}, "shin_length=0.3: only the quadruped has it, not walker"),
        ("hard", "perturbations='hard': expected a dict"),
    ],
)
def test_wrong_perturbations_are_named_before_mujoco_loads(wrong, message):
    with pytest.raises(ValueError, match=message):
        make_dmc_env("walker", "run", perturbations=wrong)
    code = f"""
import sys, gymnasium, sb3_dreamer_urlb
try:
    gymnasium.make("urlb/walker-run-v0", perturbations={wrong!r})
except ValueError:
    print("mujoco" in sys.modules)
"""
    assert run(code) == "False"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"domain": "walker", "level": "extreme"}, "level='extreme': expected one of easy, medium, hard"),
        ({"domain": "jaco", "level": "easy"}, "domain='jaco': the Real-World RL suite's levels are of walker, quadruped"),
        ({"domain": "walker", "task": "run"}, "task='run'"),
        ({"domain": "walker", "level": "hard", "hard_thigh": "mine"}, "hard_thigh='mine': expected one of suite, paper"),
        ({"domain": "walker", "level": "easy", "hard_thigh": "paper"}, "only the walker's level hard has two ranges"),
        ({"domain": "walker", "colour": 1}, "unknown option colour: known are action_repeat, .*hard_thigh, .*keep_buffers"),
        ({"domain": "walker", "keep_buffers": 2}, "keep_buffers=2"),
    ],
)
def test_wrong_levels_are_answered_with_the_known_ones(arguments, message):
    with pytest.raises(ValueError, match=message):
        make_rwrl_env(**arguments)


def test_the_suites_quadruped_starts_on_its_feet():
    env = make_rwrl_env("quadruped", level="easy", observation="state")
    upright = []
    for seed in range(3):
        env.reset(seed=seed)
        upright.append(env._control.physics.torso_upright())
    np.testing.assert_allclose(upright, 1, atol=1e-6)
