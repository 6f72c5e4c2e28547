"""Latent dynamics discrepancy along the trajectories of an oracle."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch as th
import torch.nn.functional as F
from counter_task import ENV, STATES, STEPS
from gymnasium import spaces
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import VecNormalize

from sb3_dreamer_urlb import DreamerV2
from sb3_dreamer_urlb.analysis.discrepancy import check_comparable, latent_dynamics_discrepancy
from sb3_dreamer_urlb.analysis.novelty import intrinsic_reward_on
from sb3_dreamer_urlb.analysis.trajectories import (
    Trajectory,
    as_batch,
    load_trajectories,
    play_trajectories,
    save_trajectories,
)


@pytest.fixture
def trajectories(tuned):
    return play_trajectories(DreamerV2.load(tuned, device="cpu"), make_vec_env(ENV, 2), 3, seed=7)


def prior_by_hand(rssm, stoch, deter, action):
    """From the equations of docs/algorithm.md, with torch's own layers."""
    x = F.elu(rssm.input(th.cat([stoch, action], -1)))
    reset, candidate, update = rssm.gru_norm(rssm.gru(th.cat([x, deter], -1))).chunk(3, -1)
    update = th.sigmoid(update - 1)
    deter = update * th.tanh(th.sigmoid(reset) * candidate) + (1 - update) * deter
    logits = rssm.prior_logits(F.elu(rssm.prior_hidden(deter)))
    return logits.view(-1, *rssm.logits_shape).softmax(-1).double()


def test_brute_force(snapshots, tuned, trajectories):
    before, after = (DreamerV2.load(path, device="cpu") for path in (snapshots(), tuned))
    found = latent_dynamics_discrepancy(before, after, trajectories, seed=5)
    model, total = after.policy.agent.world_model, []
    th.manual_seed(5)
    with th.no_grad():
        for one in trajectories:
            batch = as_batch(after.policy, one)
            state = model.observe(model.preprocess(batch.observation), batch.action, batch.is_first).state
            apart = []
            for t in range(len(one)):
                z = state.stoch[:, t], state.deter[:, t], batch.action[:, t + 1]
                p, q = (prior_by_hand(m.policy.agent.world_model.rssm, *z) for m in (after, before))
                m = (p + q) / 2
                apart.append((0.5 * (p * (p / m).log()).sum(-1) + 0.5 * (q * (q / m).log()).sum(-1)).mean().item())
            total.append(np.mean(apart))
    assert found == pytest.approx(total, rel=1e-3, abs=1e-7)
    assert all(0 < value < math.log(2) for value in found)


def test_a_model_does_not_differ_from_itself(tuned, trajectories):
    one, other = (DreamerV2.load(tuned, device="cpu") for _ in range(2))
    before = th.get_rng_state()
    assert latent_dynamics_discrepancy(one, other, trajectories) == [0.0, 0.0, 0.0]
    assert th.equal(before, th.get_rng_state())


def test_disjoint_models_are_ln_2_apart(tuned, trajectories):
    one, other = (DreamerV2.load(tuned, device="cpu") for _ in range(2))
    for model, sign in ((one, 1), (other, -1)):
        logits = model.policy.agent.world_model.rssm.prior_logits
        with th.no_grad():
            logits.weight.zero_()
            logits.bias.copy_(500.0 * sign * th.tensor([1.0, -1.0]).repeat(logits.bias.numel() // 2))
    assert latent_dynamics_discrepancy(one, other, trajectories) == pytest.approx([math.log(2)] * 3, abs=1e-9)


def test_a_folder_gives_back_what_was_played(tuned, trajectories, tmp_path):
    save_trajectories(trajectories, tmp_path / "episodes")
    loaded = load_trajectories(tmp_path / "episodes", 2)
    assert len(loaded) == 2 and [len(one) for one in trajectories] == [STEPS] * 3
    for one, other in zip(trajectories, loaded, strict=False):
        assert np.array_equal(one.observations, other.observations) and np.array_equal(one.actions, other.actions)
        assert one.rewards.tolist() == other.rewards.tolist() == [[0.0, 1.0, 0.5][t % 3] for t in range(STEPS)]
        # The picture of the last step, not that of the next episode.
        counted = one.observations[:, :, 0, 0].astype(int).max(1)
        assert one.observations.shape == (STEPS + 1, 3, 16, 16) and len(set(counted)) > 1


# -- bad input -------------------------------------------------------------------------------------------------------------


def test_fewer_trajectories_than_asked_for(trajectories, tmp_path):
    save_trajectories(trajectories, tmp_path)
    with pytest.raises(ValueError, match=r"4 trajectories are asked for, .* holds 3"):
        load_trajectories(tmp_path, 4)
    (tmp_path / "episode-0000.npz").write_bytes(b"no episode")
    with pytest.raises(ValueError, match=r"episode-0000\.npz is no recorded episode"):
        load_trajectories(tmp_path, 3)
    with pytest.raises(FileNotFoundError, match="nowhere"):
        load_trajectories(tmp_path / "nowhere", 1)


def test_models_that_cannot_be_compared(snapshots, tuned, trajectories):
    after = DreamerV2.load(tuned, device="cpu")
    larger = DreamerV2("CnnPolicy", make_vec_env(ENV, 1), preset="tiny", policy_kwargs={"deter_size": 20}, device="cpu")
    other_decoder = DreamerV2("CnnPolicy", make_vec_env(ENV, 1), preset="tiny", device="cpu", seed=4)
    elsewhere = DreamerV2.load(snapshots(), device="cpu")
    elsewhere.domain = "jaco"
    stronger = DreamerV2.load(snapshots(), device="cpu")
    stronger.action_space = spaces.Box(-2, 2, (2,), np.float32)
    for before, said in (
        (larger, "different sizes"),
        (other_decoder, "freeze_decoder=True"),
        (elsewhere, "differ in domain"),
        (stronger, "differ in action_space"),
    ):
        with pytest.raises(ValueError, match=said):
            latent_dynamics_discrepancy(before, after, trajectories)


@pytest.mark.parametrize(
    ("part", "row", "value", "said"),
    [
        ("observation", 3, np.nan, "row 3: its observation is not finite"),
        ("action", 2, np.inf, "row 2: its action is not finite"),
        ("reward", 1, np.nan, "row 1: its reward is not finite"),
        ("action", 4, 1e6, r"row 4: the action .* is none of Box"),
        ("action", 0, -1.5, r"row 0: the action .* is none of Box"),
    ],
)
def test_impossible_episodes_give_no_number(snapshots, tuned, trajectories, tmp_path, part, row, value, said):
    save_trajectories(trajectories[:2], tmp_path)
    path = tmp_path / "episode-0001.npz"
    with np.load(path) as file:
        content = {name: np.array(file[name], np.float32) for name in file.files}
    content[part][row] = value
    np.savez(path, **content)
    before, after = (DreamerV2.load(file, device="cpu") for file in (snapshots(), tuned))
    loaded = load_trajectories(tmp_path, 2)
    for act in (lambda: latent_dynamics_discrepancy(before, after, loaded), lambda: intrinsic_reward_on(before, loaded)):
        with pytest.raises(ValueError, match=rf"episode-0001\.npz, episode 1, {said}"):
            act()


def test_agents_of_two_pre_trainings_are_told_so():
    one, other = (
        DreamerV2("MlpPolicy", VecNormalize(make_vec_env(STATES, 1)), preset="tiny", device="cpu", seed=seed).learn(4)
        for seed in (0, 1)
    )
    with pytest.raises(ValueError, match="does not come from this pre-training, or its decoder was not frozen"):
        check_comparable(one, other)


def test_trajectories_of_another_task(snapshots, tuned, trajectories):
    before, after = (DreamerV2.load(path, device="cpu") for path in (snapshots(), tuned))
    one = trajectories[0]
    foreign = Trajectory(one.observations[:, :, :8], one.actions, one.rewards)
    with pytest.raises(ValueError, match="the trajectories hold"):
        latent_dynamics_discrepancy(before, after, [foreign])
    with pytest.raises(ValueError, match="The model's actions are"):
        latent_dynamics_discrepancy(before, after, [Trajectory(one.observations, one.actions[:, :1], one.rewards)])
    with pytest.raises(ValueError, match="No trajectories"):
        latent_dynamics_discrepancy(before, after, [])
