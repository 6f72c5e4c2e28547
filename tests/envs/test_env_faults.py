"""Environments that raise, or give numbers that are none: in this process (processes that die: test_supervisor.py)."""

from __future__ import annotations

import math
import warnings

import gymnasium
import numpy as np
import pytest
from fake_envs import CounterEnv, counter
from gymnasium import spaces
from gymnasium.error import ClosedEnvironmentError, DependencyNotInstalled, ResetNeeded
from stable_baselines3.common.logger import KVWriter, Logger
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_dreamer_urlb.envs import EnvironmentFaultError, FaultGuard
from sb3_dreamer_urlb.envs.faults import FAULT, FAULTS, FORGIVEN_AFTER

ACTION = np.zeros(2, np.float32)


class PhysicsError(RuntimeError):
    """Stands for dm_control's, which is a RuntimeError, too."""


class Faulty(CounterEnv):
    """Fails as told.

    :param bad_steps: numbers of steps, counted over all episodes from 1, and what happens then
    :param bad_resets: numbers of resets, likewise
    """

    def __init__(self, *args, bad_steps=None, bad_resets=None, **kwargs):
        super().__init__(*args, **kwargs)
        self.bad_steps, self.bad_resets = dict(bad_steps or {}), dict(bad_resets or {})
        self.steps = 0

    def reset(self, **kwargs):
        observation, info = super().reset(**kwargs)
        fault = self.bad_resets.get(self.resets)
        if isinstance(fault, Exception):
            raise fault
        return (observation if fault is None else np.full_like(observation, fault)), info

    def step(self, action):
        self.steps += 1
        fault = self.bad_steps.get(self.steps)
        observation, reward, terminated, truncated, info = super().step(action)
        if isinstance(fault, Exception):
            raise fault
        if isinstance(fault, tuple):
            return np.full_like(observation, fault[0]), reward, terminated, truncated, info
        return observation, (reward if fault is None else fault), terminated, truncated, info


VECTOR = spaces.Box(-1, 1, (3,), np.float32)
FAULTS_OF_A_STEP = {
    "raises": (PhysicsError("mjWARN_BADQACC"), "PhysicsError: mjWARN_BADQACC"),
    "NaN reward": (math.nan, "the reward is nan"),
    "infinite reward": (-math.inf, "the reward is -inf"),
    "NaN observation": ((math.nan,), "the observation is not finite"),
    "infinite observation": ((math.inf,), "the observation is not finite"),
}


@pytest.mark.parametrize(("fault", "reason"), FAULTS_OF_A_STEP.values(), ids=FAULTS_OF_A_STEP)
def test_a_bad_step_ends_the_episode_as_truncated(fault, reason):
    env = FaultGuard(Faulty(10, observation_space=VECTOR, bad_steps={3: fault}))
    env.observation_space.seed(0)
    env.reset(seed=0)
    env.step(ACTION)
    before = env.step(ACTION)[0]
    with pytest.warns(RuntimeWarning, match=f"step 3: {reason}"):
        observation, reward, terminated, truncated, info = env.step(ACTION)
    assert np.array_equal(observation, before) and (reward, terminated, truncated) == (0.0, False, True)
    assert reason in info[FAULT] and info[FAULTS] == 1
    env.reset()
    assert env.step(ACTION)[4] == {}


@pytest.mark.parametrize("fault", ["gives NaN", "raises"])
def test_the_last_good_observation_is_one_where_an_array_is_used_again(fault):
    class InPlace(CounterEnv):
        def __init__(self):
            super().__init__(10, observation_space=VECTOR)
            self.seen = np.zeros(3, np.float32)

        def _observation(self):
            self.seen[0] = self.t / 10
            if self.t == 3:
                self.seen[1] = math.nan if fault == "gives NaN" else 0.5
                if fault == "raises":
                    raise PhysicsError("half-way")
            return self.seen

    env = FaultGuard(InPlace())
    env.reset()
    for _ in range(2):
        env.step(ACTION)
    with pytest.warns(RuntimeWarning, match="step 3"):
        observation, _, terminated, truncated, info = env.step(ACTION)
    assert observation.tolist() == pytest.approx([0.2, 0, 0]) and (terminated, truncated) == (False, True) and FAULT in info


def test_parts_of_a_dict_observation_are_named():
    class Parts(CounterEnv):
        def _observation(self):
            return {"position": np.zeros(2), "speed": np.array([0.0, math.inf])}

    env = FaultGuard(Parts(), max_faults=1)
    with pytest.raises(EnvironmentFaultError, match="reset: the observation 'speed' is not finite"):
        env.reset()


def test_a_reset_is_tried_again_with_another_seed():
    seeds = []

    class Seeded(Faulty):
        def reset(self, *, seed=None, options=None):
            seeds.append(seed)
            return super().reset(seed=seed, options=options)

    env = FaultGuard(Seeded(10, bad_resets={1: PhysicsError("bad start"), 2: PhysicsError("bad start")}))
    with pytest.warns(RuntimeWarning, match="reset: PhysicsError: bad start"):
        observation, _ = env.reset(seed=7)
    assert seeds == [7, 8, 9] and env.observation_space.contains(observation)
    assert env.step(ACTION)[4] == {FAULTS: 2}


def test_repeated_faults_end_the_run_with_one_error():
    env = FaultGuard(Faulty(100, bad_steps={n: PhysicsError("again") for n in range(1, 100)}), max_faults=3, name="walker 5")
    for _ in range(2):
        env.reset()
        with pytest.warns(RuntimeWarning):
            env.step(ACTION)
    env.reset()
    with pytest.raises(EnvironmentFaultError, match=r"walker 5, step 3: PhysicsError: again. That was fault 3 in a row"):
        env.step(ACTION)


def test_a_guard_inside_a_guard_ends_the_run_all_the_same():
    env = FaultGuard(FaultGuard(Faulty(100, bad_steps={1: PhysicsError("x")}), max_faults=1))
    env.reset()
    with pytest.raises(EnvironmentFaultError, match="fault 1 in a row"):
        env.step(ACTION)


@pytest.mark.parametrize("between", ["an episode", "many steps", "few steps"])
def test_what_makes_a_row_of_faults_end(between):
    steps = {"an episode": 1, "many steps": FORGIVEN_AFTER, "few steps": FORGIVEN_AFTER - 1}[between]
    bad = {1: PhysicsError("x"), 2 + steps: PhysicsError("x")}
    env = FaultGuard(Faulty(1 if between == "an episode" else None, bad_steps=bad), max_faults=2)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        for _ in range(1 + steps):
            env.reset()
            env.step(ACTION)
        if between == "few steps":
            with pytest.raises(EnvironmentFaultError, match="fault 2 in a row"):
                env.step(ACTION)
        else:
            assert FAULT in env.step(ACTION)[4]


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_bad_action_is_the_agents_fault(value):
    inner = CounterEnv(10)
    env = FaultGuard(inner, name="walker")
    env.reset()
    with pytest.raises(ValueError, match=rf"walker, step 1: the agent's action \[ ?0. +{value}\] is not finite"):
        env.step(np.array([0, value]))
    assert inner.received == [[]]


def test_no_faults_at_all_is_refused():
    with pytest.raises(ValueError, match="max_faults must be positive, got 0"):
        FaultGuard(CounterEnv(), max_faults=0)


def test_attributes_reach_through():
    env = FaultGuard(CounterEnv(action_repeat=4))
    assert env.get_wrapper_attr("action_repeat") == 4


# -- a run -----------------------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_a_run_goes_on_and_stores_no_bad_row(tiny_model):
    bad = {30: PhysicsError("x"), 41: math.nan, 77: math.inf}
    envs = [FaultGuard(Faulty(20, bad_steps=bad)), CounterEnv(20)]
    model = tiny_model(DummyVecEnv([lambda i=i: Monitor(envs[i]) for i in range(2)]), buffer_size=1000)
    model.learn(240)
    assert model.env_faults == 3 and model._n_updates > 0
    model.replay_buffer.close_streams()
    episodes = list(model.replay_buffer.episodes)
    assert all(np.isfinite(episode.reward).all() and not episode.is_terminal.any() for episode in episodes)
    # Within an episode every frame follows the one before, so none holds a made-up row.
    assert all((np.diff(counter(episode.observation)) == 1).all() for episode in episodes)
    # Steps 21 to 29 of the first environment were good, 30 was not; 31 to 40, then 41; 42 to 61, 62 to 76, then 77.
    lengths = sorted(len(episode) for episode in episodes)
    assert lengths == sorted([21, 10, 11, 21, 16, 21, 21, 4] + [21] * 6)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
def test_faults_are_logged(tiny_model, tmp_path):
    model = tiny_model(FaultGuard(Faulty(20, bad_steps={30: math.nan})))
    logged = []
    rows = type("Rows", (KVWriter,), {"write": lambda _, values, *args, **kwargs: logged.append(dict(values))})()
    model.set_logger(Logger(None, [rows]))
    model.learn(100, log_interval=1)
    assert logged[0]["rollout/env_faults"] == 0 and logged[-1]["rollout/env_faults"] == 1


def test_without_a_guard_the_error_names_environment_and_step(tiny_model):
    env = DummyVecEnv([lambda: CounterEnv(50), lambda: Faulty(50, bad_steps={4: math.nan})])
    with pytest.raises(ValueError, match=r"Environment 1, step 8: the reward is nan.*FaultGuard"):
        tiny_model(env).learn(40)


def test_an_action_that_is_not_finite_stops_the_run(tiny_model, monkeypatch):
    model = tiny_model()
    monkeypatch.setattr(model.policy, "scale_action", lambda actions: np.full_like(actions, np.nan))
    monkeypatch.setattr(model.policy, "choose", lambda state, deterministic: _with_nan(state))
    with pytest.raises(ValueError, match=r"The policy, step 0: the agent's action .*nan.* is not finite"):
        model.learn(10)


def _with_nan(state):
    state.action = state.action * math.nan
    return state


def test_the_walker_survives_a_physics_error():
    control = pytest.importorskip("dm_control.rl.control")
    env = FaultGuard(gymnasium.make("urlb/walker-stand-v0", image_size=16))
    env.reset(seed=0)
    env.step(env.action_space.sample())
    physics = env.unwrapped._control.physics
    physics.data.qvel[:] = np.nan
    with pytest.warns(RuntimeWarning, match="PhysicsError"):
        *_, truncated, info = env.step(env.action_space.sample())
    assert truncated and control.PhysicsError.__name__ in info[FAULT]
    observation, _ = env.reset()
    assert observation.shape == (16, 16, 3) and FAULT not in env.step(env.action_space.sample())[4]
    env.close()


# -- what is no fault ------------------------------------------------------------------------------------------------------


class Freed(CounterEnv):
    """Cannot be used after ``close()``, and does not say why."""

    freed = False

    def close(self):
        self.freed = True

    def reset(self, **kwargs):
        assert not self.freed
        return super().reset(**kwargs)

    def step(self, action):
        assert not self.freed
        return super().step(action)


class SaysSo(Freed):
    def reset(self, **kwargs):
        if self.freed:
            raise ClosedEnvironmentError("this one was closed")
        return super().reset(**kwargs)

    def step(self, action):
        if self.freed:
            raise ClosedEnvironmentError("this one was closed")
        return super().step(action)


@pytest.mark.parametrize(("kind", "closes", "message"), [
    (Freed, lambda env: env.close(), "Freed.*was closed: make a new one"),
    (SaysSo, lambda env: env.close(), "this one was closed"),
    (SaysSo, lambda env: env.unwrapped.close(), "this one was closed"),
])  # fmt: skip
@pytest.mark.filterwarnings("error")
def test_a_closed_environment_ends_at_once(kind, closes, message):
    env = FaultGuard(FaultGuard(kind()))
    env.reset()
    env.step(ACTION)
    closes(env)
    for use in (lambda: env.step(ACTION), env.reset):
        with pytest.raises(ClosedEnvironmentError, match=message):
            use()


@pytest.mark.filterwarnings("error")
def test_what_may_be_used_after_close_may_be():
    env = FaultGuard(CounterEnv())
    env.close()
    env.reset()
    env.step(ACTION)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("error", [ResetNeeded("reset first"), DependencyNotInstalled("no pygame")])
def test_mistakes_of_the_caller_are_no_faults(error):
    env = FaultGuard(Faulty(bad_steps={1: error}, bad_resets={2: error}))
    env.reset()
    for use in (lambda: env.step(ACTION), env.reset):
        with pytest.raises(type(error), match=str(error)):
            use()
