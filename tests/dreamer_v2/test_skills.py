"""Skills of DIAYN and APS: how they are drawn, stored, chosen for a task, fixed by hand, and used by the planner."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch as th
import torch.nn.functional as F
from fake_envs import CounterEnv
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.vec_env import DummyVecEnv
from tiny import infer

from sb3_dreamer_urlb import DreamerV2, PhaseSwitchCallback
from sb3_dreamer_urlb.agent import PlannedAgent
from sb3_dreamer_urlb.intrinsic import OneHotSkills, UnitSkills

SMALL = {
    "diayn": {"skill_dim": 4, "skill_interval": 3},
    "aps": {"skill_dim": 3, "skill_interval": 3, "k": 3},
}
EXAMPLES = {"diayn": np.array([0, 0, 1, 0], np.float32), "aps": np.array([0.6, 0.0, -0.8], np.float32)}


@pytest.fixture(params=["diayn", "aps"])
def method(request):
    return request.param


@pytest.fixture
def skilled(tiny_model, method):
    """Make a tiny model of a method with skills; episodes of eight steps, or of the given environment."""

    def make(env=None, **kwargs):
        env = CounterEnv(8, action_repeat=2) if env is None else env
        return tiny_model(env, intrinsic_reward=method, intrinsic_kwargs=SMALL[method], **kwargs)

    return make


# -- the spaces ------------------------------------------------------------------------------------------------------------


@given(st.integers(2, 60), st.integers(1, 50))
def test_draws(dim, n):
    one_hot, unit = OneHotSkills(dim).draw(n), UnitSkills(dim).draw(n)
    assert one_hot.shape == unit.shape == (n, dim)
    assert ((one_hot == 0) | (one_hot == 1)).all() and (one_hot.sum(1) == 1).all()
    assert th.allclose(unit.norm(dim=1), th.ones(n), atol=1e-5)


def test_draws_cover_the_space(seeded):
    counts = OneHotSkills(10).draw(5000).sum(0)
    assert ((counts - 500).square() / 500).sum() < 27.9  # chi-square, 9 degrees of freedom, p = 0.001
    assert UnitSkills(5).draw(5000).mean(0).abs().max() < 0.05


@pytest.mark.parametrize(
    ("skills", "skill", "message"),
    [
        (OneHotSkills(4), [0.0, 1.0], r"shape \(4,\), got \(2,\)"),
        (OneHotSkills(4), [[0.0, 1.0, 0.0, 0.0]], r"shape \(4,\), got \(1, 4\)"),
        (OneHotSkills(4), [0.0, 0.5, 0.5, 0.0], "one-hot"),
        (OneHotSkills(4), [0.0, 0.0, 0.0, 0.0], "one-hot"),
        (UnitSkills(2), [1.0, 1.0], "unit vector.*1.414"),
        (UnitSkills(2), [float("nan"), 1.0], "finite"),
    ],
)
def test_no_skill(skills, skill, message):
    skills.fix(skills.draw(1)[0])
    before = skills.fixed.clone()
    with pytest.raises(ValueError, match=message):
        skills.fix(th.tensor(skill))
    assert th.equal(skills.fixed, before) and skills.is_fixed


# -- acting ----------------------------------------------------------------------------------------------------------------


def test_predict_follows_a_skill_for_its_interval(skilled, method):
    model, state, seen = skilled(), None, []
    for deterministic in (False, True):
        for step in range(60):
            start = np.array([step == 0])
            _, state = model.predict(np.zeros((1, 3, 16, 16), np.uint8), state, start, deterministic)
            seen.append(state[4][0])
        changes = [t for t in range(1, 60) if not np.array_equal(seen[t], seen[t - 1])]
        assert len(changes) > 5 and all(t % 3 == 0 for t in changes)
        seen.clear()


def test_a_new_episode_gets_a_new_skill(skilled):
    model, state = skilled(), None
    first, others = set(), 0
    for step in range(40):
        starts = np.array([True, step == 0])
        _, state = model.predict(np.zeros((2, 3, 16, 16), np.uint8), state, starts)
        first.add(state[4][0].tobytes())
        assert state[5].tolist() == [1, step + 1]
    assert len(first) > 2 or others


def test_a_skill_fixed_by_hand(skilled, method, tmp_path):
    model = skilled()
    model.fix_skill(EXAMPLES[method])
    _, state = model.predict(np.zeros((3, 3, 16, 16), np.uint8))
    assert np.allclose(state[4], EXAMPLES[method])
    model.learn(20)
    assert all(np.allclose(episode.skill, EXAMPLES[method]) for episode in model.replay_buffer.episodes)
    model.save(tmp_path / "fixed")
    loaded = DreamerV2.load(tmp_path / "fixed", device="cpu")
    assert np.allclose(loaded.predict(np.zeros((3, 3, 16, 16), np.uint8))[1][4], EXAMPLES[method])
    loaded.fix_skill(None)
    drawn = {loaded.predict(np.zeros((1, 3, 16, 16), np.uint8))[1][4].tobytes() for _ in range(30)}
    assert len(drawn) > 1


def test_a_skill_by_number(skilled, method):
    model = skilled()
    if method == "aps":
        with pytest.raises(ValueError, match="have no numbers"):
            model.fix_skill(1)
        return
    model.fix_skill(2)
    assert model.policy.agent.skills.fixed.tolist() == [0, 0, 1, 0]
    with pytest.raises(ValueError, match=r"lie in \[0, 3\], got 4"):
        model.fix_skill(4)
    with pytest.raises(ValueError, match="skill must be numbers, the number of a skill, or None, got True"):
        model.fix_skill(True)


def test_methods_without_skills_say_so(tiny_model):
    with pytest.raises(ValueError, match="intrinsic_reward='lbs' has no skills"):
        tiny_model(CounterEnv(8), intrinsic_reward="lbs").fix_skill(0)


def test_actor_and_critic_depend_on_the_skill(learner, method):
    agent = learner(method).agent
    feature = th.randn(5, agent.world_model.sizes.feature)
    one, other = agent.skills.draw(2)
    assert not th.allclose(agent.actor(feature, one.expand(5, -1)).mean, agent.actor(feature, other.expand(5, -1)).mean)
    assert not th.allclose(agent.critic(feature, one.expand(5, -1)), agent.critic(feature, other.expand(5, -1)))


def test_aps_value_is_psi_times_w(learner):
    agent = learner("aps").agent
    feature, skill = th.randn(7, agent.world_model.sizes.feature), agent.skills.draw(7)
    psi = agent.critic.out(agent.critic.hidden(th.cat([feature, skill], -1)))
    assert psi.shape == (7, 5) and th.allclose(agent.critic(feature, skill), (psi * skill).sum(-1))


# -- learning --------------------------------------------------------------------------------------------------------------


def test_replay_holds_the_skill_of_each_action(skilled, monkeypatch):
    """Row t holds the skill that the action leading to it followed; the first row that of the first action."""
    model = skilled(DummyVecEnv([lambda: CounterEnv(8)] * 2))
    followed = []
    sample = DreamerV2._sample_action

    def spy(self, *args, **kwargs):
        result = sample(self, *args, **kwargs)
        followed.append(self._acting_state.skill.numpy().copy())
        return result

    monkeypatch.setattr(DreamerV2, "_sample_action", spy)
    model.learn(32)
    for number, episode in enumerate(model.replay_buffer.episodes):
        env, begin = number % 2, 8 * (number // 2)
        actions = np.stack([skill[env] for skill in followed[begin : begin + 8]])
        assert np.array_equal(episode.skill[1:], actions) and np.array_equal(episode.skill[0], actions[0])
    assert model.replay_buffer.sample(3).skill.shape == (3, 4, model.skill_size)


def test_each_dream_follows_its_own_skill(learner, batch, method, monkeypatch):
    its = learner(method)
    batch = dataclasses.replace(batch, skill=its.agent.skills.draw(15).view(3, 5, -1))
    seen = []
    imagine = its.agent.world_model.imagine
    monkeypatch.setattr(
        its.agent.world_model, "imagine", lambda actor, start, h, skill: seen.append(skill) or imagine(actor, start, h, skill)
    )
    for _ in range(2):
        its.update(batch)
    assert seen[0].shape == (15, its.agent.skills.dim) and not th.equal(seen[0], seen[1])
    assert len(seen[0].unique(dim=0)) > 5


def test_replay_refuses_skills_of_another_size(skilled, tiny_model, tmp_path):
    model = skilled().learn(20)
    with pytest.raises(ValueError, match=r"shape \(1, \d\), got \(1, 9\)"):
        model.replay_buffer.add(
            *[np.zeros((1, 3, 16, 16), np.uint8)] * 2, np.zeros((1, 2)), [0.0], [False], [{}], np.ones((1, 9))
        )
    model.save_replay_buffer(tmp_path / "replay")
    with pytest.raises(ValueError, match="skill"):
        tiny_model(CounterEnv(8), intrinsic_reward="lbs").load_replay_buffer(tmp_path / "replay")


# -- the choice ------------------------------------------------------------------------------------------------------------


def test_diayn_chooses_the_skill_that_acts_like_the_good_sequences(learner, batch):
    its = learner("diayn")
    agent = its.agent
    with th.no_grad():
        # Skill 7 acts near (0.9, 0.9), all others near (−0.9, −0.9), whatever the state.
        agent.actor.body.dense[0].weight.zero_()
        agent.actor.body.dense[0].bias.zero_()
        agent.actor.body.dense[0].weight[0, -50 + 7] = 10.0
        agent.actor.body.out.weight.zero_()
        agent.actor.body.out.weight[:, 0] = 0.3
        agent.actor.body.out.bias.fill_(-1.5)
    action, reward = th.full_like(batch.action, -0.9), th.zeros_like(batch.reward)
    action[1], reward[1] = 0.9, 1.0
    rows = dataclasses.replace(batch, action=action, reward=reward)
    posterior = infer(agent.world_model, rows)
    with th.no_grad():
        assert agent.intrinsic.choose_skill(agent.actor, posterior, rows).argmax() == 7
        # Were the other sequences the good ones, skill 7 would be the worst.
        rows.reward[:] = th.tensor([[1.0], [0.0], [1.0]])
        assert agent.intrinsic.choose_skill(agent.actor, posterior, rows).argmax() != 7


def test_aps_solves_least_squares(learner, batch):
    agent = learner("aps").agent
    posterior = infer(agent.world_model, batch)
    with th.no_grad():
        phi = F.normalize(agent.intrinsic.features(posterior.feature).flatten(0, 1), dim=-1)
        solution = th.linalg.lstsq(batch.reward.view(-1, 1), phi).solution[0]
        chosen = agent.intrinsic.choose_skill(agent.actor, posterior, batch)
        assert th.allclose(chosen, F.normalize(solution, dim=0), atol=1e-4)
        rewardless = dataclasses.replace(batch, reward=th.zeros_like(batch.reward))
        agent.skills.check(agent.intrinsic.choose_skill(agent.actor, posterior, rewardless))


def test_aps_weighs_states_by_their_rewards_alone(learner, batch):
    """φ of unit length, as in the reward: the length of a state's features is no vote."""
    agent = learner("aps").agent
    posterior = infer(agent.world_model, batch)
    with th.no_grad():
        chosen = agent.intrinsic.choose_skill(agent.actor, posterior, batch)
        original = agent.intrinsic.features.forward
        agent.intrinsic.features.forward = lambda feature: original(feature) * th.rand(*feature.shape[:-1], 1).add(0.1)
        assert th.allclose(agent.intrinsic.choose_skill(agent.actor, posterior, batch), chosen, atol=1e-5)


def test_fine_tuning_chooses_once_and_waits_until_then(skilled, weights, tmp_path):
    """Before the choice only the world model learns, and no planner acts; after it all do; the skill stays."""
    model = skilled(planner="dyna_mpc", learning_starts=10, skill_selection_starts=30, planner_delay=4).learn(40)
    model.fine_tune()
    agent = model.policy.agent
    before = {name: weights(module) for name, module in agent.named_children()}
    model.learn(28)
    changed = {name for name, module in agent.named_children() if weights(module) != before[name]}
    assert changed == {"world_model"} and model.phase_updates > 0
    assert not agent.skills.is_fixed and not model._planner_is_on()
    model.learn(12)
    assert agent.skills.is_fixed and model._planner_is_on()
    changed = {name for name, module in agent.named_children() if weights(module) != before[name]}
    assert {"world_model", "actor", "critic", "intrinsic"} <= changed
    chosen = agent.skills.fixed.clone()
    model.learn(20)
    assert th.equal(agent.skills.fixed, chosen) and th.equal(model._acting_state.skill[0], chosen)
    model.save(tmp_path / "chosen")
    loaded = DreamerV2.load(tmp_path / "chosen", env=CounterEnv(8), device="cpu")
    assert th.equal(loaded.policy.agent.skills.fixed, chosen) and loaded.policy.agent.skills.is_fixed
    loaded.learn(12)
    assert th.equal(loaded.policy.agent.skills.fixed, chosen)


def test_fine_tuning_keeps_what_the_skill_is_chosen_by(skilled, weights):
    """APS carries its features φ over; the authors' code forgets to."""
    model = skilled().learn(40)
    pretrained = weights(model.policy.agent.intrinsic)
    actor, critic = weights(model.policy.agent.actor), weights(model.policy.agent.critic)
    model.fine_tune(keep_actor=True)
    assert weights(model.policy.agent.intrinsic) == pretrained
    assert weights(model.policy.agent.actor) == actor and weights(model.policy.agent.critic) != critic
    assert model.learner.config.ent_coef == 1e-4
    model.learn(40)
    kept = {name: value for name, value in weights(model.policy.agent.intrinsic).items() if name != "skills.fixed"}
    assert kept == {name: value for name, value in pretrained.items() if name != "skills.fixed"}


def test_the_default_waits_for_4000_frames():
    from inspect import signature

    assert signature(DreamerV2.__init__).parameters["skill_selection_starts"].default * 2 == 4000


def test_the_phase_switch_and_the_choice_within_one_learn(skilled):
    model = skilled(planner="dyna_mpc").learn(100, callback=PhaseSwitchCallback(60))
    assert model.phase == "finetuning" and model.policy.agent.skills.is_fixed


# -- the planner -----------------------------------------------------------------------------------------------------------


def test_the_planner_asks_actor_and_critic_with_each_environments_skill(learner, method):
    agent = learner(method).agent
    skill = agent.skills.draw(2)
    planned = PlannedAgent(agent, skill)
    feature = th.randn(3, 2 * 4, agent.world_model.sizes.feature)  # four trajectories an environment
    values = planned.values(feature)
    for row in range(8):
        one = agent.slow_critic(feature[:, row], skill[row // 4].expand(3, -1))
        assert th.allclose(values[:, row], one, atol=1e-6)
    assert planned.act(feature[0], None).shape == (8, 2)
