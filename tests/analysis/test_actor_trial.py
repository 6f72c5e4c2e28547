"""Keep or drop the actor by what it finds."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch as th
from counter_task import ENV, STEPS
from fake_envs import CounterEnv
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_dreamer_urlb import DreamerV2
from sb3_dreamer_urlb.__main__ import main
from sb3_dreamer_urlb.analysis.actor_trial import ActorTrial, try_actor
from sb3_dreamer_urlb.analysis.trajectories import play_trajectories


class PaysForTheFirstNumber(gymnasium.Wrapper):
    """The reward is the first number of the action."""

    def __init__(self, sign):
        super().__init__(CounterEnv(STEPS))
        self.sign = sign

    def step(self, action):
        observation, _, terminated, truncated, info = self.env.step(action)
        return observation, self.sign * float(np.asarray(action)[0]), terminated, truncated, info


@pytest.mark.parametrize(("sign", "keep"), [(1, True), (-1, False), (0, False)])
def test_who_finds_more_is_kept(snapshots, weights, sign, keep):
    model = DreamerV2.load(snapshots(), device="cpu")
    actor = model.policy.agent.actor
    with th.no_grad():
        # Always the largest first number.
        actor.body.out.bias[0] = 50.0
    before, state = weights(model.policy), th.get_rng_state()
    env = DummyVecEnv([lambda: PaysForTheFirstNumber(sign)])
    trial = try_actor(model, env, 2)
    assert trial.keep is keep and len(trial.pretrained) == len(trial.fresh) == 2
    assert trial.frames == 4 * STEPS * model.action_repeat
    assert weights(model.policy) == before and th.equal(state, th.get_rng_state())


def test_an_environment_need_not_be_vectorised(snapshots):
    model = DreamerV2.load(snapshots(), env=gymnasium.make(ENV), device="cpu")
    expected = try_actor(model, make_vec_env(ENV, 1), 2)
    for env in (gymnasium.make(ENV), ENV):
        assert try_actor(model, env, 2) == expected
        assert len(play_trajectories(model, env, 1)) == 1
    with pytest.raises(ValueError, match="does not fit the model"):
        try_actor(model, gymnasium.make("CartPole-v1"), 1)


def test_where_neither_finds_anything_the_actor_goes():
    assert not ActorTrial((0.0, 0.0), (0.0, 0.0), 10).keep


def test_who_has_no_actor_is_refused(snapshots, tuned):
    env = make_vec_env(ENV, 1)
    with pytest.raises(ValueError, match="There is no actor to keep"):
        try_actor(DreamerV2.load(snapshots("random"), device="cpu"), env)
    with pytest.raises(ValueError, match="this model is in 'finetuning'"):
        try_actor(DreamerV2.load(tuned, device="cpu"), env)


def test_the_command(snapshots, capsys):
    assert main(["keep-actor", str(snapshots()), "--env", ENV, "--episodes", "2", "--device", "cpu"]) == 0
    out = capsys.readouterr().out
    assert "drop the actor, after 64 frames; the paper's rule by domains: keep" in out
