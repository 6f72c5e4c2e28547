"""One pre-training learns what several tasks pay, and fine-tuning begins with the head of its own."""

from __future__ import annotations

import numpy as np
import pytest
import torch as th
from fake_envs import CounterEnv
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from sb3_dreamer_urlb import DreamerV2, PhaseSwitchCallback

TASKS = ["stand", "fly"]


class TellingEnv(CounterEnv):
    """Pays 0 for standing and 5 for flying, whatever one does."""

    def step(self, action):
        seen, reward, terminated, truncated, info = super().step(action)
        return seen, reward, terminated, truncated, {**info, "domain_rewards": {"fly": 5.0, "stand": 0.0, "walk": 1.0}}


def vec_env(kind=TellingEnv, task="stand"):
    return DummyVecEnv([lambda: Monitor(kind(8, task=task))])


@pytest.mark.parametrize("through_a_file", [True, False])
@pytest.mark.parametrize("method", ["lbs", "icm"])
def test_fine_tuning_begins_with_the_head_of_its_task(tiny_model, weights, tmp_path, method, through_a_file):
    model = tiny_model(vec_env(), intrinsic_reward=method, learn_task_reward=TASKS).learn(30)
    heads = {name: weights(head) for name, head in model.policy.agent.task_rewards.items()}
    assert list(heads) == TASKS and heads["fly"] != heads["stand"]
    if through_a_file:
        model.save(tmp_path / "snapshot")
        model = DreamerV2.load(tmp_path / "snapshot", device="cpu")
    # The fine-tuning's environment tells its own reward only.
    model.fine_tune(vec_env(CounterEnv, "fly"), keep_reward=True)
    assert weights(model.policy.agent.world_model.reward) == heads["fly"]
    assert model.policy.agent.task_rewards is None and model.kept["reward"]
    model.learn(12)
    assert "task_rewards" not in model.replay_buffer.columns()


@pytest.mark.parametrize("method", ["lbs", "icm"])
def test_the_heads_touch_nothing_else(tiny_model, weights, method):
    alone, beside = (tiny_model(vec_env(), intrinsic_reward=method, learn_task_reward=t).learn(30) for t in (False, TASKS))
    for part in ("world_model", "actor", "critic", "intrinsic"):
        assert weights(alone.policy.agent.get_submodule(part)) == weights(beside.policy.agent.get_submodule(part)), part
    assert alone.policy.agent.task_rewards is None and "task_rewards" not in alone.replay_buffer.columns()


def test_each_head_learns_what_its_task_pays(tiny_model):
    model = tiny_model(
        vec_env(), intrinsic_reward="icm", learn_task_reward=TASKS, learning_rate=3e-2, train_freq=1, gradient_steps=6
    )
    model.learn(60)
    feature = th.zeros(1, model.policy.agent.world_model.sizes.feature)
    with th.no_grad():
        stand, fly = (head(feature).item() for head in model.policy.agent.task_rewards.values())
    assert fly > 1.5 > stand


def test_what_is_replayed(tiny_model, tmp_path):
    model = tiny_model(vec_env(), intrinsic_reward="lbs", learn_task_reward=TASKS).learn(30)
    batch = model.replay_buffer.sample(3)
    first = batch.is_first.numpy()
    paid = batch.task_rewards.numpy()
    assert paid.shape == (*first.shape, 2) and set(np.unique(paid)) <= {0.0, 5.0} and (paid[~first] == [0.0, 5.0]).all()
    model.save_replay_buffer(tmp_path / "replay")
    other = tiny_model(vec_env(), intrinsic_reward="lbs", learn_task_reward=TASKS)
    other.load_replay_buffer(tmp_path / "replay")
    assert (other.replay_buffer.episodes[0].task_rewards[1:] == [0.0, 5.0]).all()


def test_bad_input(tiny_model, weights):
    model = tiny_model(vec_env(CounterEnv), intrinsic_reward="lbs", learn_task_reward=TASKS)
    with pytest.raises(ValueError, match="does not tell the rewards of stand, fly: make it with domain_rewards=True"):
        model.learn(30)
    model = tiny_model(vec_env(), intrinsic_reward="lbs", learn_task_reward=TASKS).learn(30)
    before = weights(model.policy)
    for task, said in (("walk", "the environment's task is 'walk'"), (None, "task is None")):
        with pytest.raises(ValueError, match=f"learnt the rewards of stand, fly; .*{said}"):
            model.fine_tune(vec_env(task=task), keep_reward=True)
    with pytest.raises(ValueError, match="task is 'walk'"):
        model.learn(8, callback=PhaseSwitchCallback(1000, env=vec_env(task="walk"), keep_reward=True))
    assert model.phase == "pretraining" and weights(model.policy) == before
    normalized = VecNormalize(vec_env(), norm_obs=False)
    with pytest.raises(ValueError, match="norm_reward=False"):
        tiny_model(normalized, intrinsic_reward="lbs", learn_task_reward=TASKS).learn(30)
    for wrong in (["a", "a"], [], "stand", [1], ["a b"]):
        with pytest.raises(ValueError, match="learn_task_reward must be True, False, or a list of names"):
            tiny_model(vec_env(), intrinsic_reward="lbs", learn_task_reward=wrong)
