"""Observation and action spaces: what the networks see, what the replay holds, what the environment gets."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch as th
from fake_envs import CounterEnv
from gymnasium import spaces
from planning_forms import StepByStep
from space_kinds import ACTIONS, OBSERVATIONS, VECTOR
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from told import told_meanwhile

from sb3_dreamer_urlb import DreamerV2
from sb3_dreamer_urlb.nn.distributions import OneHotChoices
from sb3_dreamer_urlb.planning import CategoricalDynaMPC, PlannerConfig
from sb3_dreamer_urlb.replay import SequenceReplayBuffer
from sb3_dreamer_urlb.spaces.actions import make_actions
from sb3_dreamer_urlb.spaces.observations import Classes, DictObservations, Images, Numbers, vectors
from sb3_dreamer_urlb.types import LatentState
from sb3_dreamer_urlb.world_model.decoder import make_decoder
from sb3_dreamer_urlb.world_model.encoder import make_encoder


def _learnt(tiny_model, policy, env, **kwargs):
    model = tiny_model(env, policy=policy, **kwargs).learn(30)
    assert model._n_updates > 0 and all(th.isfinite(value).all() for value in model.policy.state_dict().values())
    return model


# -- observations ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", [None, "rnd"])
@pytest.mark.parametrize("name", OBSERVATIONS)
def test_learn_save_load_predict(tiny_model, tmp_path, name, method):
    policy, space, policy_kwargs = OBSERVATIONS[name]
    env = CounterEnv(8, observation_space=space)
    model = _learnt(tiny_model, policy, env, intrinsic_reward=method, policy_kwargs=policy_kwargs)
    model.save(tmp_path / "model")
    loaded = DreamerV2.load(tmp_path / "model", device="cpu")
    space.seed(0)
    observation = space.sample()
    expected, state = model.predict(observation, deterministic=True)
    assert expected.shape == (2,) and len(state[0]) == 1
    assert np.array_equal(loaded.predict(observation, deterministic=True)[0], expected)


@pytest.mark.parametrize("name", OBSERVATIONS)
def test_the_model_learns_to_see(tiny_model, name):
    """One batch over and over: what is decoded comes closer to what was seen."""
    policy, space, policy_kwargs = OBSERVATIONS[name]
    space.seed(0)
    model = _learnt(tiny_model, policy, CounterEnv(8, observation_space=space), policy_kwargs=policy_kwargs)
    model.learner.model_optimizer.set_learning_rate(3e-3)
    batch = model.replay_buffer.sample(2)
    kinds = {"image_loss", "vector_loss"}
    losses = [sum(float(v) for k, v in model.learner.update(batch).items() if k in kinds) for _ in range(60)]
    assert np.mean(losses[-5:]) < np.mean(losses[:5]) - 1e-3


def test_images_are_scaled_to_half():
    kind = Images(spaces.Box(0, 255, (1, 16, 16), np.uint8))
    assert kind.preprocess(th.tensor([0, 255], dtype=th.uint8)).tolist() == [-0.5, 0.5]
    kind = Images(spaces.Box(-1, 3, (1, 16, 16), np.float32), normalize_images=False)
    assert kind.preprocess(th.tensor([-1.0, 1.0, 3.0])).tolist() == [-0.5, 0.0, 0.5]


@pytest.mark.parametrize("lead", [(), (2,), (2, 3)])
def test_classes_become_one_hot(lead):
    raw = th.tensor([5, 1]).expand(*lead, 2)
    kind = Classes(spaces.MultiDiscrete([2, 3], start=[4, 0]))
    assert kind.size == 5 and th.equal(kind.preprocess(raw), th.tensor([0.0, 1, 0, 1, 0]).expand(*lead, 5))
    kind = Classes(spaces.Discrete(3, start=-1))
    assert th.equal(kind.preprocess(th.tensor(1).expand(lead)), th.tensor([0.0, 0, 1]).expand(*lead, 3))


def test_numbers_stay_as_they_are_and_images_are_divided():
    raw = th.arange(12, dtype=th.float64).reshape(2, 2, 3)
    assert th.equal(Numbers(spaces.Box(-9, 9, (2, 3))).preprocess(raw), raw.float().reshape(2, 6))
    image = spaces.Box(0, 255, (1, 2, 2), np.uint8)
    white = th.full((5, 1, 2, 2), 255, dtype=th.uint8)
    assert th.equal(Numbers(image).preprocess(white), th.ones(5, 4))
    assert th.equal(Numbers(image, normalize_images=False).preprocess(white), th.full((5, 4), 255.0))


def test_a_vectors_loss_is_its_likelihood():
    kind = vectors(VECTOR)
    mean, target = th.randn(2, 3, 5), th.randn(2, 3, 5)
    expected = -th.distributions.Normal(mean, 1.0).log_prob(target).sum(-1).mean()
    assert th.allclose(kind.losses(mean, target)["vector_loss"], expected)


def test_the_parts_of_a_dict():
    space = spaces.Dict({"a": VECTOR, "b": spaces.Discrete(3), "c": spaces.Box(0, 255, (1, 16, 16), np.uint8)})
    kind = DictObservations(space)
    raw = {"a": th.randn(2, 5), "b": th.tensor([0, 2]), "c": th.zeros(2, 1, 16, 16, dtype=th.uint8)}
    seen = kind.preprocess(raw)
    encoder, decoder = make_encoder(kind, 2, [7, 6]), make_decoder(kind, 4, 2, [7])
    embed = encoder(seen)
    assert embed.shape == (2, encoder.embed_size) and encoder.embed_size == 6 + 6 + encoder.encoders[2].embed_size
    assert th.equal(embed[:, :6], encoder.encoders[0](seen["a"])) and th.equal(embed[:, 6:12], encoder.encoders[1](seen["b"]))
    mean = decoder(th.zeros(2, 4))
    assert {key: part.shape for key, part in mean.items()} == {key: part.shape for key, part in seen.items()}
    losses = kind.losses(mean, seen)
    parts = [vectors(space[key]).losses(mean[key], seen[key])["vector_loss"] for key in "ab"]
    assert set(losses) == {"vector_loss", "image_loss"} and th.allclose(losses["vector_loss"], sum(parts))
    with pytest.raises(ValueError, match=r"lacks \['b', 'c'\]"):
        kind.check({"a": raw["a"]})


def test_replay_of_dict_observations():
    space = spaces.Dict({"a": spaces.Box(-9, 9, (2,)), "b": spaces.Discrete(9)})
    buffer = SequenceReplayBuffer(100, space, spaces.Discrete(2), "cpu", n_envs=2, batch_length=3, seed=0)
    for t in range(6):
        now, then = ({"a": np.array([[s, 0], [s, 1]], np.float32), "b": np.array([s, s])} for s in (t, t + 1))
        buffer.add(now, then, np.full((2, 2), t, np.float32), np.zeros(2), np.array([False, t == 5]), [{}, {}])
    assert sorted(name for name in buffer.episodes[0].columns if "observation" in name) == ["observation/a", "observation/b"]
    batch = buffer.sample(50)
    assert batch.observation["a"].shape == (50, 3, 2) and batch.observation["b"].shape == (50, 3)
    assert th.equal(batch.observation["a"][..., 0], batch.observation["b"].float())  # the parts of a row stay together
    assert (batch.observation["a"][..., 1] == 1).all()  # only the finished stream
    assert (batch.observation["b"].diff(dim=1) == 1).all() and set(batch.observation["b"].unique().tolist()) == set(range(7))
    assert th.equal(batch.action[:, 1:, 0], batch.observation["b"][:, 1:].float() - 1)


@pytest.mark.parametrize("as_dict", [False, True])
def test_vec_normalize_keeps_originals_in_the_replay(tiny_model, as_dict):
    box = spaces.Box(-100, 100, (2,), np.float32)
    space = spaces.Dict({"a": box}) if as_dict else box

    class Steps(CounterEnv):
        def _observation(self):
            seen = np.array([self.t, 50], np.float32)
            return {"a": seen} if as_dict else seen

    env = VecNormalize(DummyVecEnv([lambda: Steps(8, observation_space=space)] * 2), clip_obs=100.0)
    model = _learnt(tiny_model, "MultiInputPolicy" if as_dict else "MlpPolicy", env)
    episode = model.replay_buffer.episodes[0]
    rows = episode.observation["a"] if as_dict else episode.observation
    assert np.allclose(rows, [[t, 50] for t in range(9)], atol=1e-4)
    drawn = model.replay_buffer.sample(20, env=env).observation
    drawn, moments = (drawn["a"], env.obs_rms["a"]) if as_dict else (drawn, env.obs_rms)
    seen = drawn[..., 0].numpy() * np.sqrt(moments.var[0] + env.epsilon) + moments.mean[0]
    assert np.allclose(seen, seen.round(), atol=1e-3) and np.allclose(np.diff(seen), 1, atol=1e-3)


# -- actions ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ACTIONS)
def test_actions_go_there_and_back(name):
    space = ACTIONS[name]
    space.seed(0)
    kind = make_actions(space)
    chosen = np.stack([space.sample() for _ in range(50)])
    inside = kind.from_env(chosen)
    assert inside.shape == (50, kind.size) and inside.dtype == np.float32
    back = kind.to_env(inside)
    assert back.dtype == space.dtype and back.shape == chosen.shape and np.allclose(back, chosen, atol=1e-6)
    random = kind.to_env(kind.random(50, None, th.device("cpu")).numpy())
    assert all(space.contains(action) for action in random) and len(np.unique(random, axis=0)) > 1


@pytest.mark.parametrize("kwargs", [{}, {"intrinsic_reward": "plan2explore"}, {"intrinsic_reward": "random"}])
@pytest.mark.parametrize("name", ["discrete", "from two", "table"])
def test_learning_with_choices(tiny_model, name, kwargs):
    space = ACTIONS[name]
    env = CounterEnv(8, action_space=space)
    model = _learnt(tiny_model, "CnnPolicy", env, **kwargs)
    assert all(space.contains(action) for action in env.received[0])
    assert len(np.unique(np.stack(env.received[0]))) > 1
    action = model.replay_buffer.episodes[0].action
    assert set(np.unique(action)) == {0.0, 1.0}  # one-hot
    assert np.array_equal(action[1:].sum(-1), np.full(len(action) - 1, len(make_actions(space).classes)))
    # What the replay remembers is what the environment got.
    assert np.array_equal(model.policy.to_env_action(action[1:]), np.stack(env.received[0]))
    for deterministic in (True, False):
        chosen, _ = model.predict(env.reset()[0], deterministic=deterministic)
        assert space.contains(chosen if chosen.shape else chosen[()])


def test_choices_density():
    logits = th.randn(4, 5, generator=th.Generator().manual_seed(0)).requires_grad_()
    ours = OneHotChoices(logits, (2, 3))
    theirs = [th.distributions.Categorical(logits=part) for part in logits.split((2, 3), -1)]
    assert th.allclose(ours.entropy(), sum(part.entropy() for part in theirs))
    action = ours.sample()
    index = [part.argmax(-1) for part in action.split((2, 3), -1)]
    log_prob = sum(part.log_prob(i) for part, i in zip(theirs, index, strict=True))
    assert th.allclose(ours.log_prob(action.detach()), log_prob)
    assert ours.mode.sum(-1).tolist() == [2.0] * 4 and th.equal(ours.mode[:, :2].argmax(-1), logits[:, :2].argmax(-1))
    (gradient,) = th.autograd.grad(action[:, 0].sum(), logits)
    assert gradient.abs().sum() > 0  # straight through


def test_how_often_choices_are_drawn():
    probs = th.tensor([0.1, 0.9, 0.2, 0.3, 0.5])
    drawn = OneHotChoices(probs.log().expand(20000, 5), (2, 3)).sample(th.Generator().manual_seed(0))
    assert th.allclose(drawn.mean(0), probs, atol=0.015)


class _Guess(StepByStep):
    """A model that rewards one sequence of choices; the state counts the steps."""

    answer = (1, 0, 2)

    def step(self, state, action, generator):
        reward = th.stack([action[:, self.answer[i]] for i in range(3)], -1)
        t = state.deter[:, :1].long()
        return LatentState(reward.gather(1, t.clamp(max=2)), state.deter + 1)

    def rewards(self, feature):
        return feature[..., 0]

    def values(self, feature):
        return feature[..., 0]

    def discounts(self, feature):
        return th.ones_like(feature[..., 0])

    def act(self, feature, generator):
        return th.eye(3)[th.zeros(feature.shape[0], dtype=th.long)]


@pytest.mark.parametrize("explore", [False, True])
def test_the_planner_finds_the_best_choices(explore):
    config = PlannerConfig(horizon=3, n_samples=64, iterations=6, top_k=8, temperature=5.0, min_std=0.05)
    planner = CategoricalDynaMPC(config, 1.0, (3,))
    start = LatentState(th.zeros(2, 1), th.zeros(2, 1))
    action, probs = planner.plan(_Guess(), start, th.zeros(2, 3, 3), th.Generator().manual_seed(0), explore)
    assert action.sum(-1).tolist() == [1.0, 1.0]
    assert probs[:, :3].argmax(-1).tolist() == [list(_Guess.answer)] * 2
    assert th.allclose(probs.sum(-1), th.ones(2, 3)) and probs.min() >= 0.05 / 3 - 1e-6
    if not explore:
        assert action.argmax(-1).tolist() == [1, 1]


@pytest.mark.parametrize("planner", ["dyna_mpc", "mppi"])
def test_planning_with_choices(tiny_model, planner):
    space = spaces.MultiDiscrete([2, 3])
    model = _learnt(tiny_model, "CnnPolicy", CounterEnv(8, action_space=space), planner=planner)
    assert model._planner_is_on()
    observation = CounterEnv().reset()[0]
    action, state = model.predict(observation, deterministic=True)
    assert space.contains(action) and state[3].shape == (1, 3, 5) and math.isclose(state[3][0, 0, :2].sum(), 1, rel_tol=1e-5)
    again, _ = model.predict(observation, deterministic=True)
    assert np.array_equal(action, again)


BYTES = {"low": 0, "high": 255, "dtype": np.uint8}
MAYBE_IMAGES = {
    "gray": spaces.Box(shape=(16, 16), **BYTES),
    "film": spaces.Box(shape=(4, 16, 16, 3), **BYTES),
    "floats, channels last": spaces.Box(0, 1, (16, 20, 3)),
    "floats, channels first": spaces.Box(0, 1, (1, 16, 20)),
}
NO_IMAGES = {
    "image": spaces.Box(shape=(16, 16, 3), **BYTES),
    "bytes": spaces.Box(shape=(20,), **BYTES),
    "heights": spaces.Box(-1, 1, (20, 20)),
    "small": spaces.Box(-1, 1, (3, 4, 5)),
    "class": spaces.Discrete(3),
}


@pytest.mark.parametrize("name", [*MAYBE_IMAGES, *NO_IMAGES])
def test_what_may_be_meant_as_an_image_is_not_flattened_silently(tiny_model, name):
    space = spaces.Dict(one={**MAYBE_IMAGES, **NO_IMAGES}[name], two=VECTOR)
    env = CounterEnv(8, observation_space=space)
    with told_meanwhile() as told_now:
        tiny_model(env, "MultiInputPolicy")
    said = [text for text in told_now if "not as an image" in text]
    assert len(said) == (name in MAYBE_IMAGES)
    assert all(text.startswith("Observation 'one' is seen as a vector of ") for text in said)


@pytest.mark.parametrize("space", [spaces.Text(4), spaces.Sequence(spaces.Discrete(2))], ids=str)
def test_observations_that_are_no_arrays_are_named(tiny_model, space):
    with pytest.raises(ValueError, match=rf"arrays of numbers, .*got {type(space).__name__}"):
        tiny_model(CounterEnv(8, observation_space=space), "MlpPolicy")
