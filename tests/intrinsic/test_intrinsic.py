"""The exploration methods behind their one interface: what each learns, what it rewards, and how one's own joins them."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import torch as th
import torch.nn.functional as F
from fake_envs import CounterEnv
from hypothesis import given
from hypothesis import strategies as st
from tiny import infer

from sb3_dreamer_urlb import DreamerV2, IntrinsicReward, register_intrinsic_reward
from sb3_dreamer_urlb.intrinsic import (
    APS,
    APT,
    DIAYN,
    RND,
    OneHotSkills,
    Plan2Explore,
    RewardSource,
    make_intrinsic_reward,
    registered_intrinsic_rewards,
    registry,
)
from sb3_dreamer_urlb.intrinsic.moments import RunningMoments
from sb3_dreamer_urlb.types import Imagination

METHODS = ["icm", "plan2explore", "rnd", "lbs", "apt", "diayn", "aps", "random"]
WITH_MODULE = [name for name in METHODS if name not in ("apt", "random")]
WITH_ACTOR = [name for name in METHODS if name != "random"]
FEW = {"apt": {"k": 3}, "aps": {"k": 3}}


@pytest.fixture
def rows(batch):
    """The random batch, with skills of a given size."""

    def make(learner):
        skills = learner.agent.skills
        if skills is None:
            return batch
        lead = batch.reward.shape
        return dataclasses.replace(batch, skill=skills.draw(lead.numel()).view(*lead, -1))

    return make


@pytest.fixture
def model_of(tiny_model):
    """Make a tiny model that explores in a given way, episodes of eight steps."""

    def make(name, **kwargs):
        kwargs = {"intrinsic_kwargs": FEW.get(name), **kwargs}
        return tiny_model(CounterEnv(8, action_repeat=2), intrinsic_reward=name, **kwargs)

    return make


def test_the_papers_eight_methods():
    assert set(METHODS) <= set(registered_intrinsic_rewards())


# -- all of them -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", METHODS)
def test_an_update(learner, rows, name, weights):
    """Finite metrics; the task's reward never reaches the actor."""
    its = learner(name, reward_trains_model=False)
    its.updates = 1
    actor = weights(its.agent.actor)
    metrics = its.update(rows(its))
    assert all(math.isfinite(value) for value in metrics.values())
    assert (weights(its.agent.actor) != actor) == (name != "random")
    assert ("intrinsic_loss" in metrics) == (name in WITH_MODULE)
    assert ("intrinsic_reward" in metrics) == (name in WITH_ACTOR)
    assert ("intrinsic_replay_reward" in metrics) == (name in ("icm", "rnd"))
    assert all(len(f"train/{metric}") <= 36 for metric in metrics)


@pytest.mark.parametrize("name", WITH_MODULE)
def test_its_loss_falls(learner, rows, name):
    its = learner(name, learning_rate=3e-3)
    batch = rows(its)
    losses = [its.update(batch)["intrinsic_loss"].item() for _ in range(40)]
    assert np.mean(losses[-5:]) < np.mean(losses[:5])


@pytest.mark.parametrize("name", WITH_ACTOR)
def test_its_reward_is_finite_and_not_constant(learner, rows, name):
    its = learner(name)
    batch = rows(its)
    for _ in range(3):
        metrics = its.update(batch)
    assert math.isfinite(metrics["imagined_reward"]) and metrics["imagined_reward_std"] > 0


@pytest.mark.parametrize("name", METHODS)
@pytest.mark.parametrize("n_envs", [1, 2])
def test_pretrain_save_load_fine_tune_predict(tiny_model, weights, tmp_path, name, n_envs):
    from stable_baselines3.common.vec_env import DummyVecEnv

    env = DummyVecEnv([lambda: CounterEnv(8, action_repeat=2)] * n_envs)
    model = tiny_model(env, intrinsic_reward=name, intrinsic_kwargs=FEW.get(name), planner="dyna_mpc")
    model.learn(40).save(tmp_path / "snapshot")
    assert model.phase_updates > 0
    loaded = DreamerV2.load(tmp_path / "snapshot", env=env, device="cpu")
    assert weights(loaded.policy) == weights(model.policy)
    loaded.fine_tune()
    skilled = name in ("diayn", "aps")
    assert (loaded.policy.agent.intrinsic is not None) == skilled
    loaded.learn(60)
    assert loaded._planner_is_on()
    action, state = loaded.predict(env.reset(), episode_start=np.ones(n_envs, bool), deterministic=True)
    assert action.shape == (n_envs, 2) and state[4].shape == (n_envs, loaded.skill_size)
    loaded.save(tmp_path / "finetuned")
    again = DreamerV2.load(tmp_path / "finetuned", env=env, device="cpu")
    same, _ = again.predict(env.reset() * 0 + 3, episode_start=np.ones(n_envs, bool), deterministic=True)
    expected, _ = loaded.predict(env.reset() * 0 + 3, episode_start=np.ones(n_envs, bool), deterministic=True)
    assert np.array_equal(same, expected) and again.learner.reward_source.momentum == 1.0


@pytest.mark.parametrize("name", ["rnd", "aps"])
def test_running_statistics_travel_in_snapshots(model_of, tmp_path, name):
    model = model_of(name).learn(40)
    model.save(tmp_path / "model")
    kept = [entry for entry in model.policy.agent.state_dict() if "moments.count" in entry]
    loaded = DreamerV2.load(tmp_path / "model", device="cpu").policy.agent.state_dict()
    assert kept and all(loaded[entry] > 1 and loaded[entry] == model.policy.agent.state_dict()[entry] for entry in kept)


# -- what each rewards -----------------------------------------------------------------------------------------------------


def dream(learner, steps=4, n=6):
    """Random features and actions."""
    agent = learner.agent
    sizes = agent.world_model.sizes
    skill = None if agent.skills is None else agent.skills.draw(n)
    feature = th.randn(steps, n, sizes.feature, requires_grad=True)
    return Imagination(feature, th.rand(steps, n, sizes.action) * 2 - 1, th.zeros(steps - 1, n), skill)


def test_the_base_class_is_the_tasks_reward(learner, batch):
    its, source = learner(), RewardSource()
    imagination = dream(its)
    head = its.agent.world_model.reward
    assert th.equal(source.reward(imagination, head), head(imagination.feature))
    assert source.replay_reward(None, batch) is batch.reward and source.loss(None, batch) is None


def test_plan2explore_rewards_the_variance_of_its_models(learner):
    its = learner("plan2explore")
    imagination, method = dream(its), its.agent.intrinsic
    reward = method.reward(imagination, None)
    guesses = [model(th.cat([imagination.feature[1], imagination.action[2]], -1)).detach().numpy() for model in method.models]
    assert np.allclose(reward[2].detach().numpy(), np.var(guesses, 0, ddof=1).mean(-1), rtol=1e-4)
    assert not reward[0].any()


def test_icm_and_rnd_label_the_replay_for_the_reward_head(learner, batch, monkeypatch):
    for name in ("icm", "rnd"):
        its = learner(name)
        learnt = []
        loss = its.agent.world_model.loss

        def spy(posterior, image, reward, *others, loss=loss, learnt=learnt):
            learnt.append(reward)
            return loss(posterior, image, reward, *others)

        monkeypatch.setattr(its.agent.world_model, "loss", spy)
        its.update(batch)
        assert learnt[0].shape == batch.reward.shape and not learnt[0].requires_grad
        assert not th.allclose(learnt[0], batch.reward)
        imagination = dream(its)
        head = its.agent.world_model.reward
        assert th.equal(its.reward_source.reward(imagination, head), head(imagination.feature))


def test_icm_by_hand(learner, batch):
    its = learner("icm")
    posterior, method = infer(its.agent.world_model, batch), its.agent.intrinsic
    guess = method.forward_model(th.cat([posterior.embed[1, 2], batch.action[1, 3]]))
    reward = method.replay_reward(posterior, batch)
    assert reward[1, 3].item() == pytest.approx(math.log1p((guess - posterior.embed[1, 3]).norm().item()), rel=1e-5)
    assert (reward[:, 0] == 1).all()


@pytest.mark.parametrize("k", [1, 3, 24])
def test_apt_rewards_distance_to_the_nearest(learner, k):
    its = learner("apt")
    its.agent.intrinsic.k = k
    imagination = dream(its)
    deter = imagination.feature[..., -8:].detach().flatten(0, 1)
    direct = (deter[:, None] - deter[None]).norm(dim=-1).topk(k, largest=False).values.mean(-1).log1p()
    assert th.allclose(its.agent.intrinsic.reward(imagination, None).flatten(), direct, atol=1e-6)


def test_diayn_rewards_what_tells_the_skill(learner):
    its = learner("diayn")
    imagination, method = dream(its), its.agent.intrinsic
    reward = method.reward(imagination, None)
    assert reward.shape == (4, 6)
    q = method.discriminator(imagination.feature[2, 4]).softmax(-1)
    expected = th.log(q[imagination.skill[4].argmax()] / (1 / 50))
    assert reward[2, 4].item() == pytest.approx(expected.item(), abs=1e-5)


def test_aps_rewards_following_and_spreading(learner):
    its = learner("aps")
    imagination, method = dream(its), its.agent.intrinsic
    phi = method.features(imagination.feature).detach()
    flat = phi.flatten(0, 1)
    distance = (flat[:, None] - flat[None]).norm(dim=-1).topk(3, largest=False).values
    relative = distance / (distance.mean() * distance.numel() / (distance.numel() + 1e-4))
    spread = (relative - 1e-4).clamp(min=0).mean(-1).log1p().view(4, 6)
    follows = (F.normalize(phi, dim=-1) * imagination.skill).sum(-1)
    assert th.allclose(method.reward(imagination, None), spread + follows, atol=1e-4)


@given(st.lists(st.lists(st.floats(-100, 100, width=32), min_size=2, max_size=8), min_size=1, max_size=5))
def test_running_moments_are_those_of_everything_seen(batches):
    moments = RunningMoments()
    for values in batches:
        moments.update(th.tensor(values))
    seen = np.concatenate(batches)
    assert moments.mean.item() == pytest.approx(seen.mean(), abs=1e-2)
    # Each batch's own variance is the unbiased one, as in the authors' code.
    within = sum(np.var(values, ddof=1) * len(values) for values in batches)
    between = sum((np.mean(values) - seen.mean()) ** 2 * len(values) for values in batches)
    assert moments.variance.item() == pytest.approx((within + between) / len(seen), rel=1e-2, abs=1e-1)


# -- what is known about them ----------------------------------------------------------------------------------------------


def test_rnd_knows_what_it_has_seen(learner, batch):
    """Its error falls on images seen again and again, more than on others."""
    its = learner("rnd", learning_rate=3e-3)
    other = dataclasses.replace(batch, observation=th.randint(0, 256, batch.observation.shape, dtype=th.uint8))
    error = its.agent.intrinsic._error
    with th.no_grad():
        before = [error(each).mean().item() for each in (batch, other)]
    for _ in range(150):
        its.update(batch)
    with th.no_grad():
        seen, unseen = (error(each).mean().item() / start for each, start in zip((batch, other), before, strict=True))
    assert seen < 0.5 and seen < 0.8 * unseen


def test_diayn_learns_to_tell_skills(learner, batch):
    """States that depend on the skill: accuracy beats 1/50 by far. States that do not: it cannot on new ones."""
    its = learner("diayn", learning_rate=3e-3)
    method, n = its.agent.intrinsic, 600
    skill = method.skills.draw(n)
    marks = th.randn(50, its.agent.world_model.sizes.feature)
    posterior = infer(its.agent.world_model, batch)
    for _ in range(300):
        skill = method.skills.draw(n)
        feature = skill @ marks + 0.1 * th.randn(n, marks.shape[1])
        rows = dataclasses.replace(batch, skill=skill.view(20, 30, -1))
        loss, metrics = method.loss(dataclasses.replace(posterior, feature=feature.view(20, 30, -1)), rows)
        its.intrinsic_optimizer.step(loss)
    assert metrics["accuracy"] > 0.5
    noise = dataclasses.replace(posterior, feature=th.randn(20, 30, marks.shape[1]))
    assert method.loss(noise, rows)[1]["accuracy"] < 0.1


def test_plan2explores_disagreement_falls_with_data(learner, batch):
    its = learner("plan2explore", learning_rate=3e-3)
    posterior = infer(its.agent.world_model, batch)
    posterior = dataclasses.replace(posterior, feature=posterior.feature.detach(), embed=posterior.embed.detach())
    imagination = Imagination(posterior.feature.transpose(0, 1), batch.action.transpose(0, 1), th.zeros(4, 3))
    before = its.agent.intrinsic.reward(imagination, None).mean()
    for _ in range(300):
        its.intrinsic_optimizer.step(its.agent.intrinsic.loss(posterior, batch)[0])
    assert its.agent.intrinsic.reward(imagination, None).mean() < 0.3 * before


def test_random_acts_uniformly(model_of):
    model = model_of("random").learn(40)
    obs, state, actions = np.zeros((1, 3, 16, 16), np.uint8), None, []
    for _ in range(300):
        action, state = model.predict(obs, state, deterministic=False)
        actions.append(action[0])
    low, high = np.quantile(actions, [0.1, 0.9], axis=0)
    assert np.allclose(low, -0.8, atol=0.12) and np.allclose(high, 0.8, atol=0.12)
    first = model.predict(obs, deterministic=True)
    assert np.array_equal(first[0], model.predict(obs, deterministic=True)[0])
    assert not np.array_equal(first[0], model.predict(obs, first[1], deterministic=True)[0])


# -- one's own -------------------------------------------------------------------------------------------------------------


class Bright(IntrinsicReward):
    """Likes bright embeddings."""

    def __init__(self, gain=1.0):
        super().__init__()
        self.gain = gain

    def build(self, sizes):
        self.head = th.nn.Linear(sizes.feature, 1)

    def loss(self, posterior, batch):
        target = posterior.embed.mean(-1)
        return (self.head(posterior.feature).squeeze(-1) - target).square().mean(), {"brightness": target.mean()}

    def reward(self, imagination, reward_head):
        return self.gain * self.head(imagination.feature).squeeze(-1)


register_intrinsic_reward("bright", Bright)


@pytest.mark.parametrize(
    "given", [{"intrinsic_reward": "bright", "intrinsic_kwargs": {"gain": 2.0}}, {"intrinsic_reward": Bright(2.0)},
              {"intrinsic_reward": Bright, "intrinsic_kwargs": {"gain": 2.0}}]
)  # fmt: skip
def test_ones_own_by_name_class_and_instance(tiny_model, tmp_path, given):
    model = tiny_model(CounterEnv(8), **given).learn(40)
    assert model.policy.agent.intrinsic.gain == 2.0 and "intrinsic_brightness" in model._metrics.sums
    model.save(tmp_path / "own")
    loaded = DreamerV2.load(tmp_path / "own", env=CounterEnv(8), device="cpu")
    assert loaded.policy.agent.intrinsic.gain == 2.0
    loaded.learn(24)
    loaded.fine_tune()
    loaded.learn(24)


def test_an_instance_is_a_template(tiny_model):
    """Two models may share one; it stays as it was."""
    mine = Bright()
    first, second = (tiny_model(CounterEnv(8), intrinsic_reward=mine).learn(40) for _ in range(2))
    assert not hasattr(mine, "head") and first.policy.agent.intrinsic is not second.policy.agent.intrinsic


# -- bad input -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("method", "kwargs", "message"),
    [
        ("apd", None, r"Unknown intrinsic_reward 'apd'; known are .*'aps', 'apt'.*None"),
        ("apt", {"neighbours": 3}, r"Unknown intrinsic_kwargs \['neighbours'\] for 'apt'; known are \['k'\]"),
        ("lbs", {"gain": 2}, r"Unknown intrinsic_kwargs \['gain'\] for 'lbs'; known are \[\]"),
        (None, {"k": 3}, r"intrinsic_kwargs=\{'k': 3\} need the name or the class"),
        ("apt", ["k"], r"intrinsic_kwargs must be a dictionary or None, got \['k'\]"),
        ("diayn", {"skill_dim": 1}, "skill_dim must be an integer of at least 2, got 1"),
        ("aps", {"skill_dim": 1}, "skill_dim must be an integer of at least 2, got 1"),
        ("diayn", {"skill_interval": 0}, "skill_interval must be an integer of at least 1, got 0"),
        ("plan2explore", {"ensemble_size": 1}, "ensemble_size must be an integer of at least 2, got 1"),
        ("rnd", {"output_size": 0}, "output_size must be a positive integer, got 0"),
        ("apt", {"k": 0}, "k must be .*0"),
        ("apt", {"k": 33}, "k .*33.* 32 particles"),  # (3 + 1) · 2 · 4
        ("aps", {"k": 33}, "k .*33.* 32 particles"),
    ],
)
def test_bad_input(tiny_model, method, kwargs, message):
    with pytest.raises(ValueError, match=message):
        tiny_model(CounterEnv(8), intrinsic_reward=method, intrinsic_kwargs=kwargs)


def test_hyperparameters_belong_into_the_instance():
    with pytest.raises(ValueError, match="need the name or the class of a method"):
        make_intrinsic_reward(APT(), {"k": 3})


def test_the_papers_hyperparameters():
    assert (APT().k, APS().k, APS().skills.dim, DIAYN().skills.dim, DIAYN().skills.interval) == (12, 12, 5, 50, 50)
    assert (Plan2Explore().ensemble_size, RND().output_size) == (5, 512)
    momenta = {name: method.momentum for name, method in registered_intrinsic_rewards().items() if name in METHODS}
    assert {name for name, momentum in momenta.items() if momentum == 1.0} == {"rnd", "aps"}
    assert set(momenta.values()) == {0.95, 1.0} and DIAYN.ent_coef == 0.1 and APS.ent_coef == 0.0


class Misshapen(IntrinsicReward):
    """Its reward, or the one it labels the replay with, has another shape."""

    def __init__(self, part, shape):
        super().__init__()
        self.part, self.shape = part, shape

    def reward(self, imagination, reward_head):
        return imagination.action.new_zeros(self.shape) if self.part == "reward" else super().reward(imagination, reward_head)

    def replay_reward(self, posterior, batch):
        return batch.reward.new_zeros(self.shape) if self.part == "replay_reward" else batch.reward


@pytest.mark.parametrize("shape", [(), (1,), (1, 1)])
@pytest.mark.parametrize(("part", "expected"), [("reward", r"\(H \+ 1, N\)"), ("replay_reward", r"\(B, T\)")])
def test_a_reward_of_another_shape_is_refused(tiny_model, part, expected, shape):
    model = tiny_model(intrinsic_reward=Misshapen(part, shape))
    with pytest.raises(ValueError, match=rf"Misshapen.{part} must return a float32 tensor of the shape {expected} = .*got"):
        model.learn(60)


class Wide(IntrinsicReward):
    def reward(self, imagination, reward_head):
        return super().reward(imagination, reward_head).double()


class Metrics(IntrinsicReward):
    def reward(self, imagination, reward_head):
        return imagination.action.new_zeros(imagination.action.shape[:2])

    def loss(self, posterior, batch):
        return posterior.feature.sum() * 0, {"surprise": posterior.feature.sum(-1)}


@pytest.mark.parametrize(
    ("method", "message"),
    [(Wide, r"float32 tensor .* got torch.float64"), (Metrics, "a dictionary of scalar tensors .* got")],
)
def test_what_a_method_returns_is_of_the_right_kind(tiny_model, method, message):
    with pytest.raises(ValueError, match=message):
        tiny_model(intrinsic_reward=method).learn(60)


@pytest.mark.parametrize("name", [5, "", None])
def test_a_name_is_a_text(name):
    with pytest.raises(ValueError, match="name of an intrinsic reward must be a text"):
        register_intrinsic_reward(name, Wide)


@pytest.mark.parametrize("kind", ["class", "instance", "name"])
def test_who_makes_no_reward_would_seek_the_task_s(tiny_model, monkeypatch, kind):
    class Misspelt(IntrinsicReward):
        def rewards(self, imagination, reward_head):
            return imagination.action.new_zeros(imagination.action.shape[:2])

    class AtRandom(IntrinsicReward):
        trains_actor = False

    monkeypatch.setattr(registry, "_REGISTRY", {**registry._REGISTRY, "misspelt": Misspelt})
    method = {"class": Misspelt, "instance": Misspelt(), "name": "misspelt"}[kind]
    with pytest.raises(
        ValueError, match=r"Misspelt makes no reward, and .* seek the task's: it must override reward\(self, im"
    ):
        tiny_model(intrinsic_reward=method)
    tiny_model(intrinsic_reward=AtRandom)


def test_skills_belong_to_a_skill_reward(tiny_model):
    class Half(IntrinsicReward):
        def __init__(self):
            super().__init__()
            self.skills = OneHotSkills(3)

    with pytest.raises(ValueError, match="Half has skills, so it must be a subclass of SkillReward"):
        tiny_model(CounterEnv(8), intrinsic_reward=Half)
