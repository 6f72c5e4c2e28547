"""The contract of ``predict``, and of a policy's own file."""

from __future__ import annotations

import json
import warnings
from itertools import pairwise

import numpy as np
import pytest
import torch as th
from fake_envs import CounterEnv
from gymnasium import spaces
from operator_calls import never_waiting
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, VecTransposeImage

from sb3_dreamer_urlb import DreamerPolicy, DreamerV2

SPACES = {
    "unit": spaces.Box(-1, 1, (2,), np.float32),
    "lopsided": spaces.Box(np.array([-3.0, 1.0]), np.array([0.5, 1.5]), dtype=np.float32),
    "matrix": spaces.Box(-2, 5, (2, 3), np.float32),
    "float64": spaces.Box(-0.25, 4, (1,), np.float64),
}


@pytest.fixture
def observations():
    """A function giving n images, channels last."""
    rng = np.random.default_rng(0)
    return lambda n=4: rng.integers(0, 256, (n, 16, 16, 3), np.uint8)


@pytest.fixture(params=["actor", "planner", "planner due"])
def acting(request, tiny_model):
    """A model that acts with its actor, whose planner is not due yet, or that plans."""
    model = tiny_model(planner=None if request.param == "actor" else "dyna_mpc")
    # A fresh actor hardly sees the state: let it.
    for parameter in model.policy.agent.actor.parameters():
        parameter.data.mul_(4)
    model.phase_timesteps = 14 if request.param == "planner due" else 13
    assert model._planner_is_on() == (request.param == "planner due")
    return model


def _equal_states(first, second):
    return len(first) == len(second) and all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


def test_shapes_with_and_without_a_batch_dimension(acting, observations):
    batch = observations(4)
    actions, state = acting.predict(batch)
    assert actions.shape == (4, 2) and isinstance(state, tuple)
    assert all(isinstance(part, np.ndarray) and len(part) == 4 for part in state)
    action, state = acting.predict(batch[0])
    assert action.shape == (2,) and all(len(part) == 1 for part in state)
    action, state = acting.predict(batch[1], state)
    assert action.shape == (2,)


@pytest.mark.parametrize("batched", [True, False])
def test_channels_first_or_last_is_the_same(acting, observations, batched):
    last = observations(3) if batched else observations(1)[0]
    first = np.moveaxis(last, -1, -3)
    actions = [acting.predict(obs, deterministic=True) for obs in (last, first)]
    assert np.array_equal(actions[0][0], actions[1][0]) and _equal_states(actions[0][1], actions[1][1])


def test_the_state_carries_memory(acting, observations):
    now, before = observations(2), observations(2)
    _, state = acting.predict(before, deterministic=True)
    _, remembered = acting.predict(now, state, deterministic=True)
    _, fresh = acting.predict(now, deterministic=True)
    assert not np.allclose(remembered[1], fresh[1])


def test_the_state_remembers_the_executed_action(acting, observations):
    action, state = acting.predict(observations(3))
    assert np.allclose(acting.policy.to_env_action(state[2]), action)


def test_episode_start_resets_single_environments(acting, observations):
    before, now = observations(3), observations(3)
    _, state = acting.predict(before, deterministic=True)
    starts = np.array([False, True, False])
    mixed = acting.predict(now, state, starts, deterministic=True)
    fresh, kept = (acting.predict(now, *arguments, deterministic=True) for arguments in ((), (state,)))
    for i in range(3):
        wanted, other = (fresh, kept) if starts[i] else (kept, fresh)
        assert np.array_equal(mixed[1][1][i], wanted[1][1][i]) and not np.allclose(mixed[1][1][i], other[1][1][i])
        # Not the posterior's draw, and what follows from it: the noise of a call comes from the steps of all its rows.
        assert mixed[1][-1][i] == wanted[1][-1][i] != other[1][-1][i]
    assert starts.tolist() == [False, True, False]  # evaluate_policy's own array


def test_steps_of_a_deterministic_episode_draw_independently(acting, observations):
    """The same state, but for the number of the step: posterior and plan are drawn anew, and always in the same way."""
    obs = observations(2)
    _, memory = acting.predict(obs, deterministic=True)

    def at(step):
        action, (stoch, deter, *_) = acting.predict(obs, (*memory[:-1], np.full(2, step)), deterministic=True)
        return stoch, action, deter

    steps = range(1, 33)
    draws = [at(step) for step in steps]
    assert all(np.array_equal(draw[2], draws[0][2]) for draw in draws)  # nothing else differs
    for part, least in ((0, 10), (1, 10 if acting._planner_is_on() else 1)):
        first, second = ({draw[part][row].tobytes() for draw in draws} for row in range(2))
        assert min(len(first), len(second)) >= least
    assert any(not np.array_equal(draw[0][0], draw[0][1]) for draw in draws)  # environments do not share noise, either
    for step, draw in zip(steps, draws, strict=True):
        assert all(np.array_equal(one, other) for one, other in zip(at(step), draw, strict=True))


def test_acting_never_asks_the_device_for_a_value(acting, observations, monkeypatch):
    """The seed of a deterministic step comes from ``state``, which lies on the host."""
    policy, obs = acting.policy, observations(2)
    _, state = acting.predict(obs, deterministic=True)
    tensor, _ = policy.obs_to_tensor(obs)
    memory, starts = policy._memory_of([th.as_tensor(part) for part in state]), th.tensor([False, True])

    def step():
        generator = policy._generator_of(state[-1], np.array([False, True]))
        with th.no_grad():
            return policy.choose(policy.observe(tensor, memory, starts, generator), True, generator)

    step()  # anything that torch sets up once

    with never_waiting("acting"):
        after = step()
    assert after.steps.tolist() == [2, 1]


def test_the_mean_action_of_an_episode_has_no_accidental_direction(tiny_model, observations):
    """With the same noise at every step, the mean over an episode would spread as much as a single action."""
    model = tiny_model(planner="dyna_mpc")
    model.phase_timesteps = 100
    obs, state, episode = observations(64), None, []
    for _ in range(25):
        actions, state = model.predict(obs, state, deterministic=True)
        episode.append(actions)
    single = np.std(episode[0], axis=0).mean()
    # 25 independent draws: a fifth; the plan carries some of its mean on. The same draws 25 times: about one.
    assert np.std(np.mean(episode, axis=0), axis=0).mean() < 0.6 * single


@pytest.mark.parametrize("state", [True, False])
@pytest.mark.parametrize("starts", [None, [True, True], [False, False], np.ones(2, bool)])
def test_any_mix_of_none_is_legal(acting, observations, state, starts):
    obs = observations(2)
    memory = acting.predict(obs)[1] if state else None
    action, after = acting.predict(obs, memory, starts, deterministic=True)
    assert action.shape == (2, 2)
    if not state or (starts is not None and np.all(starts)):
        assert _equal_states(after[:2], acting.predict(obs, deterministic=True)[1][:2])


def test_deterministic_repeats_and_leaves_all_generators_alone(acting, observations):
    obs = observations(3)
    th.manual_seed(1)
    _, state = acting.predict(observations(3))
    before = th.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002 - SB3's own generator
    first = acting.predict(obs, state, deterministic=True)
    assert th.equal(before[0], th.get_rng_state()) and np.array_equal(before[1], np.random.get_state()[1])  # noqa: NPY002
    th.manual_seed(2)
    again = acting.predict(obs, state, deterministic=True)
    assert np.array_equal(first[0], again[0]) and _equal_states(first[1], again[1])


def test_stochastic_varies_and_follows_the_global_seed(acting, observations):
    obs = observations(3)
    drawn = []
    for seed in (1, 1, 2):
        th.manual_seed(seed)
        drawn.append(acting.predict(obs)[0])
    assert np.array_equal(drawn[0], drawn[1]) and not np.allclose(drawn[0], drawn[2])


def test_deterministic_is_the_actors_mean(tiny_model, observations):
    model = tiny_model()
    action, state = model.predict(observations(3), deterministic=True)
    with th.no_grad():
        feature = th.as_tensor(np.concatenate([state[0], state[1]], -1))
        assert np.allclose(action, model.policy.agent.actor(feature).mean, atol=1e-6)


@pytest.mark.parametrize("deterministic", [True, False])
@pytest.mark.parametrize("name", SPACES)
@pytest.mark.parametrize("planner", [None, "dyna_mpc"])
def test_actions_have_the_spaces_dtype_and_lie_in_it(tiny_model, observations, name, planner, deterministic):
    space = SPACES[name]
    model = tiny_model(CounterEnv(action_space=space), planner=planner, learning_starts=0, planner_delay=0)
    with th.no_grad():
        model.policy.agent.actor.body.out.bias.fill_(20.0)  # the mean at the upper bound
    state = None
    for _ in range(5):
        action, state = model.predict(observations(4), state, deterministic=deterministic)
        assert action.dtype == space.dtype and action.shape == (4, *space.shape)
        assert all(space.contains(row) for row in action)
    if planner is None and deterministic:
        assert np.allclose(action, space.high)


@pytest.mark.parametrize("name", SPACES)
def test_scaling_to_the_space_is_linear(tiny_model, name):
    space = SPACES[name]
    policy = tiny_model(CounterEnv(action_space=space)).policy
    size = spaces.flatdim(space)
    for value, expected in ((-1, space.low), (1, space.high), (0, (space.low + space.high) / 2)):
        assert np.allclose(policy.to_env_action(np.full((1, size), value, np.float32))[0], expected)


def test_predict_does_not_touch_the_model(acting, observations, weights):
    counters = ["num_timesteps", "_n_updates", "_episode_num", "phase_timesteps", "phase_updates", "phase"]

    def picture():
        return weights(acting.policy), [getattr(acting, name) for name in counters], acting._acting_state

    before = picture()
    state = None
    for deterministic in (True, False):
        for _ in range(3):
            _, state = acting.predict(observations(2), state, np.array([False, True]), deterministic)
    assert picture() == before and acting.replay_buffer.size() == 0


def test_the_given_state_is_not_changed(acting, observations):
    _, state = acting.predict(observations(2))
    copy = tuple(part.copy() for part in state)
    acting.predict(observations(2), state, np.array([True, False]))
    assert _equal_states(state, copy)


def test_prediction_in_mid_training_changes_nothing(tiny_model, observations, weights):
    def learn(disturbed):
        model = tiny_model(CounterEnv(8), planner="dyna_mpc")
        model.learn(24)
        if disturbed:
            model.predict(observations(5), deterministic=True)
        return weights(model.learn(16, reset_num_timesteps=False).policy)

    assert learn(True) == learn(False)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (lambda obs, state: ((obs, {}),), "tuple"),
        (lambda obs, state: (obs, state[:3]), "tuple of 6 arrays"),
        (lambda obs, state: (obs, list(state)), "tuple of 6 arrays"),
        (lambda obs, state: (obs, tuple(part[:1] for part in state)), r"state is for 1 environments, .* for 2"),
        (lambda obs, state: (obs[:1], state), r"state is for 2 environments, .* for 1"),
        (lambda obs, state: (obs, state, np.ones(3, bool)), "episode_start has 3 entries for 2"),
        (lambda obs, state: (obs, None, np.ones(1, bool)), "episode_start has 1 entries for 2"),
        (lambda obs, state: (obs, None, np.array(["False", "no"])), "episode_start must be true or false .*'no'"),
        (lambda obs, state: (obs, None, [np.nan, 0]), "episode_start must be true or false .*nan"),
        (lambda obs, state: (obs, None, None, "no"), "deterministic must be True or False, got 'no'"),
        (lambda obs, state: (obs, (state[0] * np.nan, *state[1:])), "part 0 holds finite numbers, got float32"),
        (lambda obs, state: (obs, (*state[:-1], np.array([-3, 0]))), "part 5 holds whole numbers of at least 0, got int64"),
        (lambda obs, state: (obs, (*state[:-1], np.array([0.5, 0]))), "part 5 holds whole numbers of at least 0, got float64"),
        (lambda obs, state: (obs, (*state[:-1], np.array([0, "1"], object))), "part 5 holds whole numbers"),
        (lambda obs, state: (obs[:0],), "of no environment"),
    ],
)
def test_wrong_input_is_refused(tiny_model, observations, arguments, message):
    model, obs = tiny_model(), observations(2)
    state = model.predict(obs)[1]
    with pytest.raises(ValueError, match=message):
        model.predict(*arguments(obs, state))


def test_a_state_may_come_from_json(tiny_model, observations):
    model, obs = tiny_model(planner="dyna_mpc"), observations(2)
    model.policy.planning = True
    state = model.predict(obs, deterministic=True)[1]
    expected = model.predict(obs, state, deterministic=True)
    again = tuple(json.loads(json.dumps([part.tolist() for part in state])))
    for given in (again, tuple(part.astype(float) for part in state), tuple(map(th.as_tensor, state))):
        action, after = model.predict(obs, given, [0, 0], deterministic=True)
        assert np.array_equal(action, expected[0]) and _equal_states(after, expected[1])


def test_parts_for_unequally_many_environments_are_refused(tiny_model):
    space = spaces.Dict({"arm": spaces.Box(-1, 1, (3,), np.float32), "leg": spaces.Box(-1, 1, (2,), np.float32)})
    model = DreamerV2("MultiInputPolicy", CounterEnv(observation_space=space), preset="tiny")
    with pytest.raises(ValueError, match=r"equally many environments, got \{'arm': 2, 'leg': 3\}"):
        model.predict({"arm": np.zeros((2, 3), np.float32), "leg": np.zeros((3, 2), np.float32)})


def test_a_wrong_image_size_is_refused(tiny_model):
    with pytest.raises(ValueError, match="observation"):
        tiny_model().predict(np.zeros((20, 20, 3), np.uint8))


@pytest.mark.parametrize("n_envs", [1, 3])
def test_evaluate_policy_in_any_number_of_environments(acting, n_envs):
    env = VecTransposeImage(DummyVecEnv([lambda: CounterEnv([5, 7, 9], rewards=[1.0])] * n_envs))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # no Monitor
        returns, lengths = evaluate_policy(acting, env, n_eval_episodes=3 * n_envs, return_episode_rewards=True)
    assert sorted(lengths) == sorted([5, 7, 9] * n_envs) and returns == [float(length) for length in lengths]


def test_evaluation_threads_state_and_plan(acting, monkeypatch):
    """What arrives in ``predict`` is what the call before returned."""
    seen = []
    original = DreamerPolicy.predict

    def spy(self, observation, state=None, episode_start=None, deterministic=False):
        result = original(self, observation, state, episode_start, deterministic)
        seen.append((state, result[1], None if episode_start is None else episode_start.copy()))
        return result

    monkeypatch.setattr(DreamerPolicy, "predict", spy)
    evaluate_policy(acting, acting.get_env(), n_eval_episodes=2)
    assert seen[0][0] is None and all(later[0] is earlier[1] for earlier, later in pairwise(seen))
    assert [bool(start[0]) for *_, start in seen].count(True) == 2
    horizon = 0 if acting.planner is None else 3
    assert all(state[3].shape == (1, horizon, 2) for _, state, _ in seen)
    planned = any(np.abs(state[3]).sum() > 0 for _, state, _ in seen)
    assert planned == acting._planner_is_on()


def test_the_plan_is_shifted_on_and_forgotten_at_an_episodes_start(tiny_model, observations, monkeypatch):
    model = tiny_model(planner="dyna_mpc", learning_starts=0, planner_delay=0)
    given = []
    original = type(model.policy.planner).plan

    def spy(self, agent, state, previous_mean, generator, explore):
        given.append((previous_mean.clone(), explore))
        return original(self, agent, state, previous_mean, generator, explore)

    monkeypatch.setattr(type(model.policy.planner), "plan", spy)
    _, state = model.predict(observations(2))
    model.predict(observations(2), state, np.array([True, False]), deterministic=True)
    assert given[0][0].abs().sum() == 0 and given[0][1] and not given[1][1]
    assert given[1][0][0].abs().sum() == 0 and np.array_equal(given[1][0][1], state[3][1])


def test_a_state_from_before_the_planner_came_is_accepted(tiny_model, observations):
    _, state = tiny_model().predict(observations(2))
    planning = tiny_model(planner="dyna_mpc", learning_starts=0, planner_delay=0)
    action, after = planning.predict(observations(2), state)
    assert state[3].shape == (2, 0, 2) and after[3].shape == (2, 3, 2) and action.shape == (2, 2)


def test_save_and_load_a_policy(acting, observations, tmp_path):
    acting.policy.save(tmp_path / "policy.pth")
    policy = DreamerPolicy.load(tmp_path / "policy.pth", device="cpu")
    obs = observations(3)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, value in acting.policy.state_dict().items():
            assert th.equal(value, policy.state_dict()[name])
    policy.planning = acting._planner_is_on()
    assert np.array_equal(policy.predict(obs, deterministic=True)[0], acting.predict(obs, deterministic=True)[0])


def test_a_loaded_policy_acts_as_the_model_did(tiny_model, observations, tmp_path):
    model = tiny_model(intrinsic_reward="lbs", planner="dyna_mpc")
    expected = model.predict(observations(1), deterministic=True)[1][3]
    model.policy.save(tmp_path / "policy.pth")
    policy = DreamerPolicy.load(tmp_path / "policy.pth", device="cpu")
    assert np.array_equal(policy.predict(observations(1), deterministic=True)[1][3], expected)


def test_call_of_the_policy_acts_at_an_episodes_beginning(acting, observations):
    tensor, _ = acting.policy.obs_to_tensor(observations(3))
    with th.no_grad():
        action = acting.policy(tensor, deterministic=True)
    assert action.shape == (3, 2) and action.abs().max() <= 1


def test_standalone_policy():
    image, action = spaces.Box(0, 255, (3, 40, 40), np.uint8), SPACES["unit"]
    policy = DreamerPolicy(image, action, lambda _: 0.0, 8, 8, 2, 4, 2, [8, 8])
    chosen, state = policy.predict(np.zeros((40, 40, 3), np.uint8))
    assert action.contains(chosen) and state[0].shape == (1, 8)
    assert DreamerV2.policy_aliases["CnnPolicy"] is DreamerPolicy


@pytest.mark.filterwarnings("error")
def test_tensors_and_arrays_that_nobody_may_write_to(tiny_model):
    env = CounterEnv(observation_space=spaces.Box(-1, 1, (3,), np.float32))
    model = tiny_model(env, "MlpPolicy")
    seen = np.random.default_rng(0).normal(size=(2, 3)).astype(np.float16).astype(np.float32)
    expected, state = model.predict(seen, deterministic=True)
    given = [
        th.tensor(seen),
        th.tensor(seen, requires_grad=True),
        th.tensor(seen).double(),
        seen.tolist(),
        list(map(th.tensor, seen)),
    ]
    for one in given:
        assert np.array_equal(model.predict(one, deterministic=True)[0], expected)
    assert model.predict(th.tensor(seen).bfloat16(), deterministic=True)[0].shape == expected.shape
    for part in (seen, *state):
        part.setflags(write=False)
    model.predict(seen, state=state)
