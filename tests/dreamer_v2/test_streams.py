"""Stored rows are rows that an environment gave one after the other, whatever happens between and within calls of learn."""

from __future__ import annotations

import copy
import io
import pickle

import numpy as np
import pytest
from fake_envs import CounterEnv, counter
from gymnasium import spaces
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import initialize, invariant, rule
from learning_machine import LearningMachine
from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecEnvWrapper, VecNormalize

from sb3_dreamer_urlb import DreamerV2
from sb3_dreamer_urlb.envs import SupervisedVecEnv, worker
from sb3_dreamer_urlb.envs.faults import FaultGuard
from sb3_dreamer_urlb.envs.touches import last_touches


class TellingEnv(CounterEnv):
    """Remembers what each of its frames was; pixel (0, 2) says which environment it is.

    :param number: of this environment
    :param reused: give the same array, and the same ``info``, each time
    """

    def __init__(self, number=0, reused=False, **kwargs):
        super().__init__((6, 3, 9), **kwargs)
        self.number, self.reused, self.array, self.info = number, reused, None, {}
        #: by frame: None for a reset, else action, reward and whether the state is terminal
        self.told = []
        self.failing = None

    def _observation(self):
        image = super()._observation()
        image[0, 2] = self.number
        if not self.reused:
            return image
        if self.array is None:
            self.array = image
        self.array[:] = image
        return self.array

    def reset(self, **kwargs):
        observation, _ = super().reset(**kwargs)
        self.told.append(None)
        self.info.clear()
        return observation, self.info

    def step(self, action):
        if self.failing is not None:
            error, self.failing = self.failing, None
            raise error
        observation, _, terminated, truncated, _ = super().step(action)
        reward = float(self.frames % 7)
        self.told.append((np.array(action), reward, terminated))
        return observation, reward, terminated, truncated, self.info if self.reused else {}


class Stop(Exception):
    """Of a callback."""


def check_streams(model, envs):
    """Every episode is a piece of what one environment told. Returns how many steps of learning are stored."""
    steps = 0
    for episode in [*model.replay_buffer.episodes, *filter(None, model.replay_buffer.open)]:
        rows = episode.rows(0, len(episode))
        frames, numbers = counter(rows["observation"]), rows["observation"][:, 0, 0, 2]
        assert len(set(numbers.tolist())) == 1
        assert frames.tolist() == list(range(frames[0], frames[0] + len(frames)))
        told = envs[int(numbers[0])].told[frames[0] : frames[-1] + 1]
        assert not rows["is_terminal"][0] and not rows["action"][0].any() and rows["reward"][0] == 0
        for its, action, reward, terminal in zip(
            told[1:], rows["action"][1:], rows["reward"][1:], rows["is_terminal"][1:], strict=True
        ):
            assert its is not None, "a reset lies between two rows"
            np.testing.assert_allclose(its[0], action, atol=1e-6)
            assert its[1:] == (reward, terminal)
        steps += len(episode) - 1
    return steps


class Streams(LearningMachine):
    """Random interleavings of all that may touch a model's environments."""

    @initialize(
        n=st.integers(1, 3),
        normalized=st.booleans(),
        terminates=st.booleans(),
        reused=st.booleans(),
        overlap=st.booleans(),
    )
    def begin(self, n, normalized, terminates, reused, overlap):
        self.n, self.normalized, self.kind, self.envs = n, normalized, {"terminates": terminates, "reused": reused}, {}
        self.model = DreamerV2(
            "CnnPolicy",
            self.new_env(),
            preset="tiny",
            seed=0,
            device="cpu",
            overlap=overlap,
            learning_starts=200,
            replay_buffer_kwargs={"sampling": "rows"},
        )
        self.learnt = 0

    def new_env(self):
        numbers = range(len(self.envs), len(self.envs) + self.n)
        self.envs |= {i: TellingEnv(i, **self.kind) for i in numbers}
        env = DummyVecEnv([lambda i=i: Monitor(self.envs[i]) for i in numbers])
        return VecNormalize(env, norm_obs=False) if self.normalized else env

    @rule(steps=st.integers(1, 30), anew=st.booleans())
    def learn_on(self, steps, anew):
        self.learn(steps, reset_num_timesteps=anew)

    @rule(after=st.integers(1, 12), raises=st.booleans(), anew=st.booleans())
    def stopped_by_a_callback(self, after, raises, anew):
        def stop(local, _):
            if raises and local["self"].num_timesteps >= until:
                raise Stop
            return local["self"].num_timesteps < until

        until = after + (0 if anew else self.model.num_timesteps)
        try:
            self.learn(100, stop, reset_num_timesteps=anew)
            assert not raises
        except Stop:
            assert raises

    @rule(after=st.integers(1, 12), where=st.sampled_from(["model's", "raw"]))
    def evaluates_while_learning(self, after, where):
        done = []

        def evaluate(local, _):
            if len(done) < 1 and local["self"].num_timesteps >= until:
                done.append(True)
                self.evaluate(where)
            return True

        until = after + self.model.num_timesteps
        self.learn(20, evaluate, reset_num_timesteps=False)

    @rule(where=st.sampled_from(["model's", "raw"]))
    def evaluate(self, where):
        env = self.model.get_env()
        evaluate_policy(self.model, env if where == "model's" else env.unwrapped.envs[0], n_eval_episodes=1, warn=False)

    @rule(which=st.integers(0, 2), level=st.sampled_from(["outer", "inner", "raw"]))
    def reset(self, which, level):
        env = self.model.get_env()
        {"outer": env, "inner": env.unwrapped, "raw": env.unwrapped.envs[which % self.n].unwrapped}[level].reset()

    @rule(which=st.integers(0, 2))
    def step(self, which):
        env = self.model.get_env().unwrapped.envs[which % self.n].unwrapped
        if env.resets:
            env.step(np.zeros(2, np.float32))

    @rule(which=st.integers(0, 2), error=st.sampled_from([RuntimeError, KeyboardInterrupt]))
    def a_step_fails(self, which, error):
        self.model.get_env().unwrapped.envs[which % self.n].unwrapped.failing = error("no")
        with pytest.raises(error, match="no"):
            self.learn(10, reset_num_timesteps=False)

    @rule(error=st.sampled_from([RuntimeError, KeyboardInterrupt]))
    def storing_fails(self, error):
        original, calls = self.model._store_transition, []

        def failing(*args):
            calls.append(args)
            if len(calls) == 3:
                raise error("no")
            original(*args)

        self.model._store_transition = failing
        try:
            with pytest.raises(error, match="no"):
                self.learn(30, reset_num_timesteps=False)
        finally:
            del self.model._store_transition

    @rule(steps=st.integers(1, 20))
    def another_model_learns_in_it(self, steps):
        DreamerV2("CnnPolicy", self.model.get_env(), preset="tiny", device="cpu").learn(steps)

    @rule(same=st.booleans(), force_reset=st.booleans())
    def set_env(self, same, force_reset):
        self.model.set_env(self.model.get_env() if same else self.new_env(), force_reset=force_reset)

    @rule(same=st.booleans(), force_reset=st.booleans())
    def save_and_load(self, same, force_reset):
        self.go_through_files(self.model.get_env() if same else self.new_env(), force_reset)

    @rule()
    def load_replay_alone(self):
        replay = io.BytesIO()
        self.model.save_replay_buffer(replay)
        replay.seek(0)
        self.model.load_replay_buffer(replay)

    @invariant()
    def rows_followed_each_other(self):
        if hasattr(self, "model"):
            assert check_streams(self.model, self.envs) == self.learnt


TestStreams = Streams.TestCase
TestStreams.settings = settings(max_examples=12, stateful_step_count=10, deadline=None, derandomize=True)


# -- one by one ------------------------------------------------------------------------------------------------------------


def rows_of(model):
    """Frames of each episode, and whether its last row is terminal."""
    return [(counter(e.observation).tolist(), bool(e.is_terminal[-1])) for e in model.replay_buffer.episodes]


def test_an_episode_that_a_callback_ends_with_is_whole(tiny_model):
    env = TellingEnv(terminates=True)
    model = tiny_model(env, replay_buffer_kwargs={"sampling": "rows"})
    for _ in range(3):
        model.learn(100, callback=StopTrainingOnMaxEpisodes(1), reset_num_timesteps=False)
    assert rows_of(model) == [(list(range(7)), True), (list(range(7, 11)), True), (list(range(11, 21)), True)]
    assert model._episode_num == len(model.ep_info_buffer) == 3


class SilentEnd(VecEnvWrapper):
    """Tells nobody the last observation of an episode, and gives lists."""

    def reset(self):
        return self.venv.reset()

    def step_wait(self):
        observation, reward, done, infos = self.venv.step_wait()
        return observation, reward.tolist(), done.tolist(), [{"TimeLimit.truncated": False} for _ in infos]


def test_the_next_episodes_start_ends_no_episode(tiny_model):
    env = SilentEnd(DummyVecEnv([lambda: TellingEnv(terminates=True)] * 2))
    model = tiny_model(env, replay_buffer_kwargs={"sampling": "rows"})
    with pytest.warns(UserWarning, match=r"without info\['terminal_observation'\]"):
        model.learn(30)
    frames, ends = zip(*rows_of(model), strict=True)
    assert all(ends) and {one[-1] - one[-2] for one in frames} == {0}
    assert all(np.diff(one[:-1]).tolist() == [1] * (len(one) - 2) for one in frames)


def test_evaluating_in_the_models_own_environment_closes_the_stream(tiny_model):
    model = tiny_model(TellingEnv(), replay_buffer_kwargs={"sampling": "rows"}).learn(8)
    evaluate_policy(model, model.get_env(), n_eval_episodes=1)
    model.learn(4, reset_num_timesteps=False)
    assert [len(frames) for frames, _ in rows_of(model)[:2]] == [7, 3]
    assert check_streams(model, [model.get_env().envs[0].unwrapped]) == 12


def test_nothing_touched_means_no_reset(tiny_model):
    """Episodes go on from one learn to the next."""
    env = TellingEnv()
    model = tiny_model(env)
    for _ in range(4):
        model.learn(4, reset_num_timesteps=False)
    assert env.told.count(None) == 3


@pytest.mark.parametrize("given", ["model's", "inner"])
def test_a_loaded_model_goes_on_where_the_environment_stands(tiny_model, tmp_path, given):
    env = TellingEnv()
    model = tiny_model(env, replay_buffer_kwargs={"sampling": "rows"}).learn(4)
    model.save(tmp_path / "model")
    where = model.get_env() if given == "model's" else model.get_env().unwrapped
    loaded = DreamerV2.load(tmp_path / "model", where, device="cpu", force_reset=False)
    assert np.array_equal(loaded._last_obs, model._last_obs) and not loaded._last_episode_starts.any()
    loaded.learn(8, reset_num_timesteps=False)
    assert loaded.num_timesteps == 12 and env.told.count(None) == 3
    # An episode has 6 steps, then 3: what the first model saw of the first is not in the second one's replay.
    assert counter(loaded.replay_buffer.episodes[0].observation).tolist() == [4, 5, 6]
    check_streams(loaded, [env])


@pytest.mark.parametrize("case", ["force_reset", "touched", "another", "other wrappers", "never used"])
def test_without_a_true_note_the_environment_is_reset(tiny_model, tmp_path, case):
    model = tiny_model(TellingEnv())
    if case != "never used":
        model.learn(4)
    model.save(tmp_path / "model")
    env = model.get_env()
    if case == "touched":
        env.reset()
    elif case == "another":
        env = DummyVecEnv([TellingEnv])
    elif case == "other wrappers":
        env = VecNormalize(env, norm_obs=False)
    loaded = DreamerV2.load(tmp_path / "model", env, device="cpu", force_reset=case == "force_reset")
    assert loaded._last_obs is None
    assert loaded.learn(4, reset_num_timesteps=False).num_timesteps == (4 if case == "never used" else 8)


def test_normalised_observations_go_on(tiny_model, tmp_path):
    space = spaces.Box(-1, 1, (3,), np.float32)
    env = VecNormalize(DummyVecEnv([lambda: CounterEnv(6, observation_space=space)]))
    model = tiny_model(env, "MlpPolicy", replay_buffer_kwargs={"sampling": "rows"}).learn(4)
    model.save(tmp_path / "model")
    loaded = DreamerV2.load(tmp_path / "model", env, device="cpu", force_reset=False)
    original = model._last_original_obs
    assert env.unwrapped.envs[0].unwrapped.resets == 1
    loaded.learn(4, reset_num_timesteps=False)
    assert env.unwrapped.envs[0].unwrapped.resets == 2
    [episode, *_] = loaded.replay_buffer.episodes
    assert np.array_equal(episode.observation[0], original[0])


@pytest.mark.parametrize("guarded", [False, True])
def test_what_ends_an_episode_outlives_the_reset(guarded):
    """One array and one info, reused: in a DummyVecEnv that a model learns in, and in our own worker."""
    env = TellingEnv(reused=True)
    if guarded:
        env = FaultGuard(env)
        env.reset()
        answers = [worker._step(env, np.zeros(2, np.float32)) for _ in range(6)]
        seen, info = answers[-1][0], answers[-1][3]
    else:
        vec_env = DummyVecEnv([lambda: env])
        last_touches(vec_env)
        vec_env.reset()
        for _ in range(6):
            seen, _, _, infos = vec_env.step(np.zeros((1, 2), np.float32))
        seen, info = seen[0], infos[0]
    last = np.asarray(info["terminal_observation"])
    assert (last[0, 0, 0], seen[0, 0, 0]) == (6, 7) and info["TimeLimit.truncated"]


def test_touches_are_told_apart():
    env, other = (DummyVecEnv([lambda: Monitor(CounterEnv())]) for _ in range(2))
    assert last_touches(env) == last_touches(env) != last_touches(other)
    inner = env.envs[0].unwrapped
    for touch in (
        env.reset,
        lambda: env.step(env.action_space.sample()[None]),
        inner.reset,
        lambda: inner.step(inner.action_space.sample()),
        lambda: env.env_method("reset"),
        lambda: VecNormalize(env, norm_obs=False).reset(),
    ):
        before = last_touches(env)
        touch()
        assert last_touches(env) != before


class WarmedUp(TellingEnv):
    def warm_up(self):
        self.reset()

    def score(self):
        return self.frames


#: VecEnvs of processes, and whether each is asked inside
PROCESSES = {
    "SubprocVecEnv": (lambda fns: SubprocVecEnv(fns, start_method="forkserver"), True),
    "SupervisedVecEnv": (SupervisedVecEnv, True),
    "unwrapped": (lambda fns: SubprocVecEnv(fns, start_method="forkserver"), False),
}


@pytest.mark.parametrize("way", PROCESSES)
def test_touches_in_other_processes_are_noticed_and_nothing_else(way):
    make, wrapped = PROCESSES[way]
    env = make([lambda: Monitor(WarmedUp()) if wrapped else WarmedUp()] * 2)
    try:
        env.reset()
        last_touches(env)
        touches = {
            "env_method": lambda: env.env_method("reset"),
            "of the second": lambda: env.env_method(method_name="reset", indices=[1]),
            "reset": env.reset,
            "evaluation's": VecNormalize(env, norm_obs=False).reset,
        }
        if wrapped:
            touches["within a method"] = lambda: env.env_method("warm_up", indices=1)
        for name, touch in touches.items():
            before = last_touches(env)
            touch()
            assert last_touches(env) != before, name
        before = last_touches(env)
        env.env_method("score"), env.get_attr("frames"), env.set_attr("color", 1), env.env_is_wrapped(Monitor)
        assert last_touches(env) == before
    finally:
        env.close()


@pytest.mark.parametrize("way", ["SubprocVecEnv", "SupervisedVecEnv"])
def test_rows_from_other_processes_followed_each_other(tiny_model, way):
    """One array and one info, reused, and a method that resets between two calls of learn."""
    env = PROCESSES[way][0]([lambda: Monitor(WarmedUp(reused=True, terminates=True))] * 2)
    try:
        model = tiny_model(env, replay_buffer_kwargs={"sampling": "rows"})
        for method in ("score", "warm_up", "score"):
            model.learn(18, reset_num_timesteps=False)
            env.env_method(method)
        told = env.get_attr("told")
        for episode in model.replay_buffer.episodes:
            frames = counter(episode.observation).tolist()
            assert frames == list(range(frames[0], frames[-1] + 1))
            assert any(
                its[frames[0]] is None
                and all(step is not None for step in its[frames[0] + 1 : frames[-1] + 1])
                and its[frames[-1]][1:] == (episode.reward[-1], episode.is_terminal[-1])
                for its in told
                if len(its) > frames[-1]
            )
        ends = [step for its in told for step in its if step is not None and step[2]]
        assert sum(bool(episode.is_terminal[-1]) for episode in model.replay_buffer.episodes) == len(ends) > 0
    finally:
        env.close()


def test_watched_environments_are_copied_and_pickled_as_ever():
    env = CounterEnv()
    vec_env = DummyVecEnv([lambda: env])
    last_touches(vec_env)
    vec_env.reset()
    env.lengths = [6]  # itertools.cycle, which reset() needs, pickles with a warning
    for copied in (copy.deepcopy(env), pickle.loads(pickle.dumps(env))):
        copied.lengths = iter([6])
        copied.reset()
        copied.step(copied.action_space.sample())
        assert (env.frames, copied.frames) == (1, 3)
