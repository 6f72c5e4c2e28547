"""Behind VecNormalize, in other processes, too: the replay holds what environments gave, statistics follow the agent."""

from __future__ import annotations

import tempfile

import numpy as np
import pytest
from gymnasium import Env, spaces
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import initialize, invariant, precondition, rule
from learning_machine import LearningMachine
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecExtractDictObs,
    VecFrameStack,
    VecMonitor,
    VecNormalize,
    VecTransposeImage,
)

from sb3_dreamer_urlb import DreamerV2, RunCheckpointCallback
from sb3_dreamer_urlb.phases import PRETRAINING

#: far beyond what VecNormalize lets through
FAR = 100_000
LENGTHS = (6, 3, 9)


class FarEnd(Env):
    """Shows its number, the frames so far, and at an episode's end something far from everything before.

    :param number: of this environment
    :param kind: "float32", "int64", or "dict" of both, of which one is normalised
    """

    def __init__(self, number=0, kind="float32"):
        box = spaces.Box(-2 * FAR, 2 * FAR, (3,), np.float32 if kind == "dict" else kind)
        self.kind = kind
        self.observation_space = spaces.Dict({"a": box, "b": spaces.Discrete(50, start=3)}) if kind == "dict" else box
        self.action_space = spaces.Box(-1, 1, (2,), np.float32)
        self.number, self.frames, self.episodes = number, 0, 0
        #: by frame: what was shown, None or the action, the reward, and whether the state is terminal
        self.told = []

    def _show(self, end, *led):
        seen = np.array([self.number, self.frames, FAR + self.frames if end else 0], self.observation_space["a"].dtype
                        if self.kind == "dict" else self.kind)  # fmt: skip
        self.told.append((seen.copy(), *led))
        self.frames += 1
        return {"a": seen, "b": 3 + self.frames % 50} if self.kind == "dict" else seen

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t, self.length = 0, LENGTHS[self.episodes % 3]
        self.episodes += 1
        return self._show(False, None, 0.0, False), {}

    def step(self, action):
        self.t += 1
        end = self.t == self.length
        reward = float(self.frames % 7)
        return self._show(end, np.array(action), reward, end), reward, end, False, {}


def rows_of(episode):
    rows = episode.rows(0, len(episode))
    return {**rows, "seen": rows["observation/a"] if "observation/a" in rows else rows["observation"]}


def check_rows(model, told):
    """Every episode is a piece of what one environment told. Returns how many steps are stored.

    :param told: of each environment, by its number
    """
    steps = 0
    for episode in [*model.replay_buffer.episodes, *filter(None, model.replay_buffer.open)]:
        rows = rows_of(episode)
        number, first = int(rows["seen"][0, 0]), int(rows["seen"][0, 1])
        its = told[number][first : first + len(episode)]
        assert len(its) == len(episode)
        for i, (seen, action, reward, terminal) in enumerate(its):
            assert np.array_equal(rows["seen"][i], seen), "not what the environment gave"
            if i == 0:
                continue
            assert action is not None, "a reset lies between two rows"
            np.testing.assert_allclose(rows["action"][i], action, atol=1e-6)
            assert (rows["reward"][i], rows["is_terminal"][i]) == (reward, terminal)
            if "observation/b" in rows:
                assert rows["observation/b"][i] == 3 + (seen[1] + 1) % 50
        steps += len(episode) - 1
    return steps


def check_drawn(model):
    """A batch is what is stored, normalised with the present statistics."""
    buffer, normalizer = model.replay_buffer, model.get_vec_normalize_env()
    if not buffer.can_sample():
        return
    before = buffer.rng.bit_generator.state
    stored = buffer.sample(3)
    buffer.rng.bit_generator.state = before
    drawn = buffer.sample(3, env=model._drawn_through())
    buffer.rng.bit_generator.state = before
    parts = [(stored.observation, drawn.observation)]
    if isinstance(stored.observation, dict):
        assert np.array_equal(stored.observation["b"], drawn.observation["b"])
        parts = [(stored.observation["a"], drawn.observation["a"])]
    for was, is_ in parts:
        shown = was.numpy()
        if normalizer.norm_obs:
            rms = normalizer.obs_rms["a"] if isinstance(normalizer.obs_rms, dict) else normalizer.obs_rms
            shown = np.clip(
                (shown - rms.mean) / np.sqrt(rms.var + normalizer.epsilon), -normalizer.clip_obs, normalizer.clip_obs
            )
        np.testing.assert_allclose(is_.numpy(), shown.astype(np.float32), rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(drawn.reward.numpy(), normalizer.normalize_reward(stored.reward.numpy()), rtol=1e-5)


def statistics(normalizer):
    """Of observations, as numbers to compare."""
    if not normalizer.norm_obs:
        return []
    parts = normalizer.obs_rms.values() if isinstance(normalizer.obs_rms, dict) else [normalizer.obs_rms]
    return [(part.mean.tolist(), part.var.tolist(), part.count) for part in parts]


class NormalizedStreams(LearningMachine):
    """Random interleavings of all that may touch a model's environments, which live in processes of their own."""

    @initialize(
        n=st.integers(2, 3),
        kind=st.sampled_from(["float32", "int64", "dict"]),
        norm_obs=st.booleans(),
        norm_reward=st.booleans(),
        explores=st.booleans(),
        overlap=st.booleans(),
    )
    def begin(self, n, kind, norm_obs, norm_reward, explores, overlap):
        self.n, self.kind, self.norm = n, kind, {"norm_obs": norm_obs, "norm_reward": norm_reward}
        self.made, self.live, self.told = 0, [], {}
        self.folders = []
        self.model = DreamerV2(
            "MultiInputPolicy" if kind == "dict" else "MlpPolicy",
            self.new_env(),
            preset="tiny",
            seed=0,
            device="cpu",
            overlap=overlap,
            learning_starts=30,
            train_freq=2,
            intrinsic_reward="icm" if explores else None,
            replay_buffer_kwargs={"sampling": "rows"},
        )
        self.learnt = 0

    def new_env(self):
        numbers = range(self.made, self.made + self.n)
        self.made += self.n
        env = SubprocVecEnv([lambda i=i: Monitor(FarEnd(i, self.kind)) for i in numbers], start_method="fork")
        self.live.append((numbers, env))
        keys = {"norm_obs_keys": ["a"]} if self.kind == "dict" and self.norm["norm_obs"] else {}
        return VecNormalize(env, clip_obs=5.0, **self.norm, **keys)

    def teardown(self):
        for _, env in getattr(self, "live", ()):
            env.close()
        for folder in getattr(self, "folders", ()):
            folder.cleanup()

    @rule(steps=st.integers(1, 40), anew=st.booleans())
    def learn_on(self, steps, anew):
        self.learn(steps, reset_num_timesteps=anew)

    @rule(after=st.integers(1, 12))
    def stopped_by_a_callback(self, after):
        until = after + self.model.num_timesteps
        self.learn(100, lambda local, _: local["self"].num_timesteps < until, reset_num_timesteps=False)

    @rule()
    def evaluate(self):
        evaluate_policy(self.model, self.model.get_env(), n_eval_episodes=1, warn=False)

    @rule(level=st.sampled_from(["outer", "inner", "called"]))
    def reset(self, level):
        env = self.model.get_env()
        {"outer": env.reset, "inner": env.unwrapped.reset, "called": lambda: env.env_method("reset", indices=[0])}[level]()

    @rule(force_reset=st.booleans())
    def set_the_same_env(self, force_reset):
        self.model.set_env(self.model.get_env(), force_reset=force_reset)

    @rule(force_reset=st.booleans(), within=st.booleans())
    def wrap_the_same_env(self, force_reset, within):
        """Between two calls of learn, or in one; the statistics are the same."""

        def wrap():
            env = self.model.get_env()
            before = statistics(env)
            keys = {"norm_obs_keys": ["a"]} if self.kind == "dict" and self.norm["norm_obs"] else {}
            self.model.set_env(VecNormalize(env.unwrapped, clip_obs=5.0, **self.norm, **keys), force_reset=force_reset)
            if self.model.num_timesteps > 0:
                assert statistics(self.model.get_env()) == before

        def in_it(*_):
            if not done:
                done.append(wrap())
            return True

        done = []
        self.learn(12, in_it, reset_num_timesteps=False) if within else wrap()

    @rule(force_reset=st.booleans())
    def set_another_env(self, force_reset):
        before = statistics(self.model.get_env())
        self.model.set_env(self.new_env(), force_reset=force_reset)
        if self.model.num_timesteps > 0:
            assert statistics(self.model.get_env()) == before

    @rule(same=st.booleans(), force_reset=st.booleans())
    def save_and_load(self, same, force_reset):
        old = self.model.get_env()
        before = statistics(old)
        self.go_through_files(old if same else self.new_env(), force_reset)
        if self.model.num_timesteps > 0:
            assert statistics(self.model.get_env()) == before

    @rule(steps=st.integers(1, 12), lost=st.integers(0, 12))
    def killed_and_resumed(self, steps, lost):
        self.folders.append(tempfile.TemporaryDirectory())
        folder = f"{self.folders[-1].name}/run"
        self.learn(steps, RunCheckpointCallback(folder, 5, handle_signals=False), reset_num_timesteps=False)
        kept, counts = self.learnt, [its[2] for its in statistics(self.model.get_env())]
        if lost:
            self.learn(lost, reset_num_timesteps=False)
        self.model, self.learnt = DreamerV2.resume(folder, self.new_env(), device="cpu"), kept
        self.learn(1, reset_num_timesteps=False)
        # A reset and a step of all environments.
        assert [its[2] for its in statistics(self.model.get_env())] == [pytest.approx(count + 2 * self.n) for count in counts]

    @precondition(lambda self: self.model.phase == PRETRAINING)
    @rule(same=st.booleans())
    def fine_tune(self, same):
        before = statistics(self.model.get_env())
        self.model.fine_tune(None if same else self.new_env())
        assert statistics(self.model.get_env()) == before
        self.learnt = 0

    @invariant()
    def replay_is_true(self):
        if hasattr(self, "model"):
            for numbers, env in self.live:
                self.told |= dict(zip(numbers, env.get_attr("told"), strict=True))
            assert check_rows(self.model, self.told) == self.learnt
            check_drawn(self.model)


TestNormalizedStreams = NormalizedStreams.TestCase
TestNormalizedStreams.settings = settings(max_examples=8, stateful_step_count=8, deadline=None, derandomize=True)


# -- one by one ------------------------------------------------------------------------------------------------------------


class FarImage(FarEnd):
    """The same in the first column of an image with channels last."""

    def __init__(self):
        super().__init__()
        self.observation_space = spaces.Box(0, 255, (16, 16, 3), np.uint8)

    def _show(self, end, *led):
        image = np.zeros((16, 16, 3), np.uint8)
        image[0, 0] = super()._show(end, *led) % 251
        return image


WRAPPED = {
    "alone": lambda: VecNormalize(DummyVecEnv([FarEnd])),
    "as ints": lambda: VecNormalize(DummyVecEnv([lambda: FarEnd(kind="int64")])),
    "a part": lambda: VecNormalize(DummyVecEnv([lambda: FarEnd(kind="dict")]), norm_obs_keys=["a"]),
    "monitored": lambda: VecMonitor(VecNormalize(VecMonitor(DummyVecEnv([FarEnd])))),
    "over a part": lambda: VecNormalize(VecExtractDictObs(DummyVecEnv([lambda: FarEnd(kind="dict")]), "a")),
}


@pytest.mark.parametrize("way", WRAPPED)
def test_the_end_of_an_episode_is_what_the_environment_gave(tiny_model, way):
    """VecNormalize clips it: it cannot be undone."""
    env = WRAPPED[way]()
    policy = "MultiInputPolicy" if isinstance(env.observation_space, spaces.Dict) else "MlpPolicy"
    model = tiny_model(env, policy, replay_buffer_kwargs={"sampling": "rows"}).learn(20)
    assert [rows_of(e)["seen"][-1].tolist() for e in list(model.replay_buffer.episodes)[:2]] == [
        [0, 6, FAR + 6],
        [0, 10, FAR + 10],
    ]


def test_fractions_are_not_kept_as_whole_numbers(tiny_model):
    ints = VecNormalize(DummyVecEnv([lambda: FarEnd(kind="int64")]))
    with pytest.raises(ValueError, match=r"VecNormalize gives fractions, .* they are int64"):
        tiny_model(VecFrameStack(ints, 2), "MlpPolicy")
    model = tiny_model(ints, "MlpPolicy")
    with pytest.raises(ValueError, match="VecNormalize gives fractions"):
        model.set_env(VecFrameStack(ints, 2))
    tiny_model(VecFrameStack(VecNormalize(DummyVecEnv([lambda: FarEnd(kind="int64")]), norm_obs=False), 2), "MlpPolicy")


@pytest.mark.parametrize("outside", [lambda env: env, VecTransposeImage, lambda env: VecMonitor(VecTransposeImage(env))])
def test_images_behind_a_normaliser_have_their_channels_first(tiny_model, outside):
    env = outside(VecNormalize(DummyVecEnv([FarImage]), norm_obs=False))
    model = tiny_model(env, replay_buffer_kwargs={"sampling": "rows"}).learn(20)
    for episode in list(model.replay_buffer.episodes)[:2]:
        assert np.diff(episode.observation[:, 1, 0, 0].astype(int)).tolist() == [1] * (len(episode) - 1)
        assert episode.observation[-1, 2, 0, 0] == (FAR + int(episode.observation[-1, 1, 0, 0])) % 251
