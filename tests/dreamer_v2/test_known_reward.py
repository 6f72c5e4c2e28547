"""The task's reward head of the pre-training, carried into fine-tuning; and the decoder that fine-tuning leaves alone."""

from __future__ import annotations

import pytest
import torch as th
from fake_envs import CounterEnv
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_dreamer_urlb import DreamerV2, DrQv2, FineTuneCallback, PhaseSwitchCallback

LABELLING = ("icm", "rnd")


def vec_env():
    return DummyVecEnv([lambda: Monitor(CounterEnv(8))])


def pretrained(tiny_model, method, **kwargs):
    return tiny_model(vec_env(), intrinsic_reward=method, **kwargs).learn(30)


@pytest.mark.parametrize("through_a_file", [True, False])
@pytest.mark.parametrize("method", ["lbs", "random", *LABELLING])
def test_fine_tuning_begins_with_the_known_reward(tiny_model, weights, tmp_path, method, through_a_file):
    model = pretrained(tiny_model, method, learn_task_reward=True)
    agent = model.policy.agent
    own = agent.task_reward if method in LABELLING else agent.world_model.reward
    assert (agent.task_reward is not None) == (method in LABELLING)
    known = weights(own)
    if through_a_file:
        model.save(tmp_path / "snapshot")
        model = DreamerV2.load(tmp_path / "snapshot", env=vec_env(), device="cpu")
    model.fine_tune(keep_reward=True)
    assert weights(model.policy.agent.world_model.reward) == known
    assert model.policy.agent.task_reward is None
    model.learn(12)


@pytest.mark.parametrize("method", ["lbs", "icm"])
def test_nobody_asks_and_the_head_is_fresh(tiny_model, weights, method):
    model = pretrained(tiny_model, method, learn_task_reward=True)
    before = weights(model.policy.agent.known_reward())
    model.fine_tune()
    assert weights(model.policy.agent.world_model.reward) != before


@pytest.mark.parametrize("method", LABELLING)
def test_the_second_head_touches_neither_model_nor_exploration(tiny_model, weights, method):
    """Bit for bit: the same weights, the same rewards, with the head and without it."""
    alone, beside = (pretrained(tiny_model, method, learn_task_reward=learns) for learns in (False, True))
    for part in ("world_model", "actor", "critic", "intrinsic"):
        assert weights(alone.policy.agent.get_submodule(part)) == weights(beside.policy.agent.get_submodule(part)), part
    assert alone.phase_updates == beside.phase_updates > 0


def test_the_second_head_learns_what_the_task_pays(tiny_model):
    model = tiny_model(
        DummyVecEnv([lambda: Monitor(CounterEnv(8, rewards=(5.0,)))]),
        intrinsic_reward="icm", learn_task_reward=True, learning_rate=3e-2, train_freq=1, gradient_steps=6,
    )  # fmt: skip
    model.learn(60)
    feature = th.zeros(1, model.policy.agent.world_model.sizes.feature)
    with th.no_grad():
        assert model.policy.agent.task_reward(feature).item() > 1.5


@pytest.mark.parametrize("method", LABELLING)
def test_without_a_head_there_is_one_error_and_the_model_stays(tiny_model, weights, method):
    model = pretrained(tiny_model, method)
    before = weights(model.policy)
    with pytest.raises(ValueError, match="learn_task_reward=True"):
        model.fine_tune(keep_reward=True)
    assert model.phase == "pretraining" and weights(model.policy) == before


def test_the_callbacks_pass_it_on(tiny_model, monkeypatch):
    given = []
    monkeypatch.setattr(DreamerV2, "_transfer", lambda self, source, *choices: given.append(choices))
    model = tiny_model(vec_env(), intrinsic_reward="lbs")
    model.learn(24, callback=PhaseSwitchCallback(16, keep_actor=False, keep_reward=True))
    model = pretrained(tiny_model, "lbs")
    model.learn(12, callback=FineTuneCallback(keep_actor=True, keep_reward=True, verbose=0))
    assert given == [(False, False, True), (True, False, True)]


def test_the_switch_says_at_the_beginning_that_there_is_no_head(tiny_model):
    model = tiny_model(vec_env(), intrinsic_reward="icm")
    with pytest.raises(ValueError, match="learn_task_reward=True"):
        model.learn(24, callback=PhaseSwitchCallback(16, keep_reward=True))
    assert model.num_timesteps == 0


def test_an_agent_without_a_model_has_no_head():
    model = DrQv2("CnnPolicy", vec_env(), preset="tiny", intrinsic_reward="disagreement", device="cpu", frame_stack=1)
    with pytest.raises(ValueError, match="DrQv2 has none"):
        model.fine_tune(keep_reward=True)


# -- the frozen decoder ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("compile", ["eager", "auto"])
def test_a_frozen_decoder_stays_bit_equal(tiny_model, weights, tmp_path, compile):
    pretrained(tiny_model, "lbs", compile=compile).save(tmp_path / "pretrained")
    model = DreamerV2.load(tmp_path / "pretrained", env=vec_env(), device="cpu", freeze_decoder=True)
    before = {part: weights(model.policy.agent.world_model.get_submodule(part)) for part in ("decoder", "rssm", "encoder")}
    model.fine_tune()
    model.learn(24)
    model.save(tmp_path / "finetuned")
    again = DreamerV2.load(tmp_path / "finetuned", env=vec_env(), device="cpu")
    assert again.freeze_decoder
    again.learn(24)
    for tuned in (model, again):
        after = {part: weights(tuned.policy.agent.world_model.get_submodule(part)) for part in before}
        assert tuned.phase_updates > 0
        assert {part: after[part] == before[part] for part in before} == {"decoder": True, "rssm": False, "encoder": False}


def test_the_decoder_learns_while_pre_training(tiny_model, weights):
    model = tiny_model(vec_env(), intrinsic_reward="lbs", freeze_decoder=True)
    before = weights(model.policy.agent.world_model.decoder)
    assert weights(model.learn(30).policy.agent.world_model.decoder) != before


@pytest.mark.parametrize("name", ["freeze_decoder", "learn_task_reward"])
def test_without_pre_training_there_is_nothing_to_freeze_or_to_know(tiny_model, name):
    with pytest.raises(ValueError, match=f"{name}=True needs a pre-training"):
        tiny_model(vec_env(), **{name: True})
