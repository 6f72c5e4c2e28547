"""Processes of environments that die, raise or hang."""

from __future__ import annotations

import functools
import math
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from fake_envs import CounterEnv, counter
from gymnasium import spaces
from gymnasium.error import ClosedEnvironmentError
from places import PYTHONPATH
from stable_baselines3.common.monitor import Monitor

from sb3_dreamer_urlb.envs import EnvironmentFaultError, SupervisedVecEnv, make_supervised_vec_env
from sb3_dreamer_urlb.envs.faults import FAULT, FAULTS

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")


class Harmful(CounterEnv):
    """Does what its action says: beyond 0.9 it kills its process, hangs, raises or gives NaN."""

    def step(self, action):
        if action[0] > 0.9:
            os.kill(os.getpid(), signal.SIGKILL)
        if action[0] < -0.9:
            time.sleep(1000)
        if action[1] > 0.9:
            raise RuntimeError("simulation unstable")
        observation, reward, terminated, truncated, info = super().step(action)
        return observation, (math.nan if action[1] < -0.9 else reward), terminated, truncated, info

    def pid(self):
        return os.getpid()

    def die(self):
        os.kill(os.getpid(), signal.SIGKILL)


class DiesAtStart(CounterEnv):
    """Kills its process as often as it is reset."""

    def reset(self, **kwargs):
        os.kill(os.getpid(), signal.SIGKILL)


def make(n_envs=2, env=Harmful, length=20, **kwargs):
    return SupervisedVecEnv([functools.partial(_monitored, env, length)] * n_envs, **{"step_timeout": 20.0, **kwargs})


def _monitored(env, length):
    return Monitor(env(length))


@pytest.fixture
def two():
    env = make()
    yield env
    env.close()


GOOD = np.zeros(2, np.float32)
KILL, HANG = np.array([1, 0], np.float32), np.array([-1, 0], np.float32)
RAISE, NAN = np.array([0, 1], np.float32), np.array([0, -1], np.float32)


def test_it_is_a_vec_env(two):
    observation = two.reset()
    assert observation.shape == (2, 16, 16, 3) and observation.dtype == np.uint8
    for step in range(1, 41):
        observation, reward, done, info = two.step([GOOD, GOOD])
        assert reward.tolist() == [(0.0, 1.0, 0.5)[(step - 1) % 20 % 3]] * 2 and done.tolist() == [step % 20 == 0] * 2
        assert all(("terminal_observation" in i) == (step % 20 == 0) == ("episode" in i) for i in info)
        assert not any(FAULT in i or FAULTS in i for i in info)
    assert len(set(two.env_method("pid"))) == 2 and two.get_attr("terminates") == [False, False]
    two.set_attr("terminates", True, 1)
    assert two.env_is_wrapped(Monitor) == [True, True] and two.has_attr("rewards") and not two.has_attr("nothing")
    with pytest.raises(AttributeError, match="nothing"):
        two.get_attr("nothing")
    assert two.get_images()[0].shape == (32, 32, 3) and two.seed(3) == [3, 4]


@pytest.mark.parametrize(
    ("harm", "reason"),
    [
        (KILL, "its process ended by signal SIGKILL"),
        (RAISE, "RuntimeError: simulation unstable"),
        (NAN, "the reward is nan"),
    ],
    ids=["dies", "raises", "gives NaN"],
)
def test_a_fault_ends_the_episode_of_its_environment_alone(two, harm, reason):
    two.reset()
    two.step([GOOD, GOOD])
    before, *_ = two.step([GOOD, GOOD])
    observation, reward, done, info = two.step([GOOD, harm])
    assert done.tolist() == [False, True] and reward[1] == 0 and FAULT not in info[0]
    assert reason in info[1][FAULT] and info[1][FAULTS] == 1 and info[1]["TimeLimit.truncated"]
    assert np.array_equal(info[1]["terminal_observation"], before[1]) and counter(observation.transpose(0, 3, 1, 2))[0] == 3
    # It goes on with a new episode of the usual length.
    ends = [t for t in range(1, 21) if two.step([GOOD, GOOD])[2][1]]
    assert ends == [20]


def test_a_hanging_worker_is_replaced():
    env = make(step_timeout=2.0)
    env.reset()
    old = env.env_method("pid")
    start = time.monotonic()
    *_, info = env.step([GOOD, HANG])
    assert "its process hangs (TimeoutError: no answer within 2 s)" in info[1][FAULT] and time.monotonic() - start < 60
    new = env.env_method("pid")
    assert new[0] == old[0] and new[1] != old[1]
    with pytest.raises(ProcessLookupError):
        os.kill(old[1], 0)
    env.close()


def test_a_worker_that_dies_between_steps(two):
    two.seed(5)
    two.set_attr("marked", "yes")
    two.reset()
    os.kill(two.env_method("pid")[0], signal.SIGKILL)
    two.workers[0].process.join(10)
    assert two.get_attr("marked") == ["yes", "yes"]  # asked again, of the new one
    *_, done, info = two.step([GOOD, GOOD])
    assert done.tolist() == [True, False] and "SIGKILL" in info[0][FAULT]
    with pytest.raises(EnvironmentFaultError, match=r"Environment 0, method .*die.*SIGKILL"):
        two.env_method("die", indices=0)


def test_repeated_deaths_end_the_run_with_one_error():
    env = make(1, max_faults=3)
    env.reset()
    for _ in range(2):
        assert env.step([KILL])[2].all()
    with pytest.raises(EnvironmentFaultError, match=r"Environment 0, step 3: its process ended .*fault 3 in a row"):
        env.step([KILL])
    env.close()
    env = make(1, DiesAtStart, max_faults=2)
    with pytest.raises(EnvironmentFaultError, match="fault 2 in a row"):
        env.reset()
    env.close()


def test_a_death_before_a_reset_is_counted_with_the_next_step(two):
    os.kill(two.env_method("pid")[1], signal.SIGKILL)
    two.workers[1].process.join(10)
    assert two.reset().shape == (2, 16, 16, 3)
    *_, done, info = two.step([GOOD, GOOD])
    assert not done.any() and FAULTS not in info[0] and info[1][FAULTS] == 1 and FAULT not in info[1]


def test_after_an_error_old_answers_are_not_mistaken(two):
    two.reset()
    two.step_async(np.array([GOOD, GOOD]))
    observation = two.reset()  # nobody took the step's answers
    assert observation.shape == (2, 16, 16, 3) and two.step([GOOD, GOOD])[2].tolist() == [False, False]


def test_an_environment_that_cannot_be_made():
    def broken():
        raise ImportError("no such simulator")

    start = time.monotonic()
    with pytest.raises(ImportError, match="no such simulator"):
        SupervisedVecEnv([broken])
    assert time.monotonic() - start < 60


@pytest.mark.parametrize("state", ["dead", "hanging", "stopped", "busy"])
def test_close_returns_within_five_seconds(state):
    env = make()
    env.reset()
    pid = env.env_method("pid")[1]
    if state == "dead":
        os.kill(pid, signal.SIGKILL)
    elif state == "stopped":
        os.kill(pid, signal.SIGSTOP)
    else:
        env.step_async(np.array([GOOD, HANG if state == "hanging" else GOOD]))
    start = time.monotonic()
    env.close()
    env.close()
    assert time.monotonic() - start < 5
    assert not any(worker.process.is_alive() for worker in env.workers)


def test_an_action_that_is_not_finite_is_refused(two):
    two.reset()
    with pytest.raises(ValueError, match=r"Environment 1, step 1: the agent's action \[ 0. nan\] is not finite"):
        two.step(np.array([[0, 0], [0, math.nan]]))


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"start_method": "fork"}, r"start_method='fork': expected one of \['forkserver', 'spawn'\].*hangs"),
        ({"step_timeout": 0}, "step_timeout must be positive and finite, got 0"),
        ({"start_timeout": math.nan}, "start_timeout must be positive and finite, got nan"),
        ({"step_timeout": math.inf}, "step_timeout must be positive and finite, got inf"),
        ({"max_faults": 0}, "max_faults must be positive, got 0"),
    ],
)
def test_arguments(kwargs, message):
    with pytest.raises(ValueError, match=message):
        make(**kwargs)


def test_dict_observations():
    space = spaces.Dict({"a": spaces.Box(-1, 1, (3,)), "b": spaces.Box(0, 255, (2, 2), np.uint8)})
    env = SupervisedVecEnv([functools.partial(CounterEnv, 20, observation_space=space)])
    observation = env.reset()
    assert {name: (part.shape, part.dtype) for name, part in observation.items()} == {
        "a": ((1, 3), np.float32),
        "b": ((1, 2, 2), np.uint8),
    }
    env.close()


def test_a_run_over_dying_workers(tiny_model):
    env = make_supervised_vec_env(functools.partial(CounterEnv, 20), 2, vec_env_kwargs={"step_timeout": 60.0})
    model = tiny_model(env, buffer_size=1000)

    def kill(local, _):
        if local["self"].num_timesteps in (60, 130):
            os.kill(env.workers[1].process.pid, signal.SIGKILL)
        return True

    model.learn(200, callback=kill)
    assert model.env_faults == 2 and model._n_updates > 0
    assert all((np.diff(counter(episode.observation)) == 1).all() for episode in model.replay_buffer.episodes)
    assert len(model.ep_info_buffer) > 0
    env.close()


def test_a_process_ends_although_its_worker_is_stopped():
    """Without close(): multiprocessing itself would wait for the worker for ever."""
    code = (
        "import os, signal, test_supervisor as t\n"
        "if __name__ == '__main__':\n"
        "    env = t.make(1); env.reset(); pid = env.env_method('pid')[0]; os.kill(pid, signal.SIGSTOP); print(pid)"
    )
    path = PYTHONPATH
    environment = {**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, timeout=200, check=True)
    with pytest.raises(ProcessLookupError):
        os.kill(int(done.stdout), 0)


def test_after_close_no_process_is_started():
    env = make()
    env.reset()
    env.close()
    before = [worker.process.pid for worker in env.workers]
    for use in (env.reset, lambda: env.step(np.zeros((2, 2))), lambda: env.get_attr("t"), lambda: env.env_method("pid")):
        with pytest.raises(ClosedEnvironmentError, match="SupervisedVecEnv was closed: make a new one"):
            use()
    assert [worker.process.pid for worker in env.workers] == before and env.counters[0].in_a_row == 0
    env.close()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"n_envs": 0}, "n_envs must be an integer of at least 1, got 0"),
        ({"n_env": 2}, "Unknown arguments .*'n_env'.* mean 'n_envs'"),
    ],
)
def test_arguments_that_cannot_be_meant(arguments, message):
    with pytest.raises(ValueError, match=message):
        make_supervised_vec_env(functools.partial(CounterEnv, 20), **arguments)
