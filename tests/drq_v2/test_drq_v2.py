"""DrQv2 as an algorithm: its defaults, its frames, its noise, its phases, and runs that go on."""

from __future__ import annotations

import inspect
import shutil
import subprocess
import sys
import warnings
from itertools import pairwise

import numpy as np
import pytest
import torch as th
from fake_envs import CounterEnv, counter
from gymnasium import spaces
from stable_baselines3.common.callbacks import ConvertCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack

from sb3_dreamer_urlb import (
    CnnPolicy,
    DreamerV2,
    DrQv2,
    FineTuneCallback,
    NumericalFaultError,
    PhaseSwitchCallback,
    RunCheckpointCallback,
    SnapshotCallback,
    SnapshotError,
)
from sb3_dreamer_urlb.dreamer_v2.export import ActingStep, to_onnx, to_torchscript
from sb3_dreamer_urlb.drq_v2.kept_parts import TRANSFER
from sb3_dreamer_urlb.drq_v2.policies import DrQPolicy
from sb3_dreamer_urlb.intrinsic import EncodedSteps, TransitionReward, register_intrinsic_reward
from sb3_dreamer_urlb.intrinsic.registry import _REGISTRY
from sb3_dreamer_urlb.transfer_rule import ACTOR_CHOICE, CRITIC_CHOICE, FRESH, KEPT


def vec_env(n_envs=1, length=8, **attributes):
    return DummyVecEnv([lambda: Monitor(CounterEnv(length, **attributes))] * n_envs)


def tiny(env=None, policy="CnnPolicy", **kwargs):
    return DrQv2(policy, vec_env() if env is None else env, **{"preset": "tiny", "seed": 0, "device": "cpu", **kwargs})


def pretrained(env=None, steps=40, **kwargs):
    return tiny(env, intrinsic_reward="disagreement", **kwargs).learn(steps)


def parts(model, weights):
    return {name: weights(model.policy.agent.get_submodule(name)) for name in TRANSFER if name != "intrinsic"}


# -- arguments -------------------------------------------------------------------------------------------------------------


def test_the_benchmarks_defaults():
    model = DrQv2("CnnPolicy", CounterEnv(size=84), buffer_size=1000, device="cpu")
    agent = model.policy.agent
    assert (model.gamma, model.tau, model.n_steps, model.batch_size, model.learning_starts) == (0.99, 0.01, 3, 256, 2000)
    assert (model.train_freq.frequency, model.gradient_steps, model.noise_std, model.noise_clip) == (2, 1, 0.2, 0.3)
    assert agent.encoder.convs[0].in_channels == 9 and agent.encoder.size == 39_200
    assert [layer.out_features for layer in agent.actor.body.dense] == [1024, 1024, 2]
    assert agent.actor.trunk[0].out_features == agent.critic.trunk[0].out_features == 50
    assert {optimizer.learning_rate for optimizer in model.learner.optimizers().values()} == {1e-4}
    assert all(optimizer.eps == 1e-8 and optimizer.weight_decay == 0 for optimizer in model.learner.optimizers().values())
    assert inspect.signature(DrQv2).parameters["buffer_size"].default == 1_000_000


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"tau": 0.0}, r"tau must lie in \(0, 1\], got 0.0"),
        ({"n_steps": 0}, "n_steps must be an integer of at least 1, got 0"),
        ({"frame_stack": 0}, "frame_stack must be an integer of at least 1, got 0"),
        ({"noise_std": -0.1}, "noise_std must be a non-negative number, or .*got -0.1"),
        ({"noise_std": (1.0, 0.1)}, r"noise_std .*got \(1.0, 0.1\)"),
        ({"noise_std": (1.0, 0.1, 0)}, r"noise_std must fall within a whole number of agent steps, .*got \(1.0, 0.1, 0\)"),
        (
            {"noise_std": (1.0, 0.1, 10.5)},
            r"noise_std must fall within a whole number of agent steps, .*got \(1.0, 0.1, 10.5\)",
        ),
        ({"noise_std": (1.0, 0.1, float("inf"))}, "noise_std must fall within a whole number of agent steps"),
        ({"replay_buffer_kwargs": {"max_episode_rows": 5}}, r"max_episode_rows=5 must not be smaller than .* 6 rows"),
        ({"noise_std": "linear(1,0.1,5)"}, "noise_std .*got 'linear"),
        ({"noise_clip": float("nan")}, "noise_clip must lie in"),
        ({"learning_rate": -1}, "learning_rate must be a non-negative number or a schedule, got -1"),
        ({"freeze_encoder": 1}, "freeze_encoder must be True or False, got 1"),
        ({"buffer_size": 5}, "buffer_size=5 must not be smaller than frame_stack .* 6 rows"),
        (
            {"intrinsic_reward": "lbs"},
            r"Unknown intrinsic_reward 'lbs'; known are \['disagreement'\].*'lbs' reads a world model",
        ),
        ({"intrinsic_reward": "disagreement", "intrinsic_kwargs": {"ensemble_size": 1}}, "ensemble_size .*got 1"),
        ({"intrinsic_reward": "disagreement", "intrinsic_kwargs": {"trains_encoder": 1}}, "trains_encoder .*got 1"),
        ({"policy_kwargs": {"feature_size": 0}}, "feature_size must be a positive integer, got 0"),
        ({"policy_kwargs": {"frame_stack": 2}}, r"Unknown policy_kwargs \['frame_stack'\]"),
        ({"preset": "large"}, "Unknown preset 'large'; known are .*'small'"),
        ({"precision": "half"}, "precision must be one of"),
        ({"compile": "yes"}, "compile must be one of"),
        ({"replay_buffer_class": dict}, "replay_buffer_class must be a subclass of NStepFrameReplayBuffer"),
        ({"policy": "MultiInputPolicy"}, r"Unknown policy 'MultiInputPolicy'; known are \['CnnPolicy', 'MlpPolicy'\]"),
    ],
)
def test_bad_arguments_are_named(kwargs, message):
    with pytest.raises(ValueError, match=message):
        tiny(**kwargs)


def test_dreamer_v2_says_whose_method_disagreement_is():
    with pytest.raises(ValueError, match=r"Unknown intrinsic_reward 'disagreement'.*reads encoded steps"):
        DreamerV2("CnnPolicy", CounterEnv(), preset="tiny", intrinsic_reward="disagreement")


@pytest.mark.parametrize("policy", ["CnnPolicy", "MlpPolicy", "MultiInputPolicy", DrQPolicy])
def test_dicts_of_observations_are_refused(policy):
    space = spaces.Dict({"a": spaces.Box(-1, 1, (2,))})
    with pytest.raises(ValueError, match="DrQv2 takes no Dict observations"):
        tiny(CounterEnv(observation_space=space), policy)


def test_a_schedule_may_be_written_in_thousands():
    assert tiny(noise_std=(1.0, 0.1, 25e3)).policy.noise_std == 1.0


def test_a_frozen_encoder_that_nobody_trained_is_told_of():
    with pytest.warns(UserWarning, match="freeze_encoder=True without a pre-training"):
        tiny(freeze_encoder=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pretrained(freeze_encoder=True).fine_tune()


def test_stacks_of_stacks_are_told_of():
    with pytest.warns(UserWarning, match="VecFrameStack.*frame_stack=1"):
        tiny(VecFrameStack(vec_env(), 3))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        tiny(VecFrameStack(vec_env(), 3), frame_stack=1)


def test_discrete_actions_are_refused():
    with pytest.raises(ValueError, match=r"DrQv2 needs a Box action space, got Discrete\(3\)"):
        tiny(CounterEnv(action_space=spaces.Discrete(3)))


# -- frames ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_envs", [1, 2])
def test_it_acts_on_the_stacks_that_it_learns_from(n_envs):
    """Every stack that the policy saw while collecting is one that replay gives for that step."""
    model = tiny(vec_env(n_envs, [3, 5, 9]), learning_starts=0, frame_stack=3)
    seen = {}
    original = model.policy.observe

    def spy(*args, **kwargs):
        memory = original(*args, **kwargs)
        for stack in memory.frames.numpy():
            seen.setdefault(tuple(counter(stack)), 0)
        return memory

    model.policy.observe = spy
    model.learn(40)
    batch = model.replay_buffer.sample(500)
    drawn = {tuple(counter(stack)) for stack in batch.observation.numpy()}
    assert drawn <= set(seen)
    # The first stack of an episode holds its first frame only, later ones run on.
    assert any(len(set(stack)) == 1 for stack in drawn)
    assert all(later - earlier in (0, 1) for stack in drawn for earlier, later in pairwise(stack))


@pytest.mark.parametrize("how", ["loaded", "its own", "a replay of before"])
def test_its_stacks_are_the_replays_where_it_goes_on_in_the_middle_of_an_episode(tmp_path, how):
    env = vec_env(2, 50)
    model = tiny(env, frame_stack=3).learn(42)
    if how == "loaded":
        model.save(tmp_path / "model")
        model = DrQv2.load(tmp_path / "model", env=env, device="cpu", force_reset=False)
    elif how == "a replay of before":
        model.save_replay_buffer(tmp_path / "replay")
        model.load_replay_buffer(tmp_path / "replay")
    acted = []
    model.learn(
        10,
        lambda *_: acted.extend(tuple(counter(stack)) for stack in model._acting_state.frames.numpy()) or True,
        reset_num_timesteps=False,
    )
    model.replay_buffer.close_streams()
    drawn = {tuple(counter(stack)) for stack in model.replay_buffer.sample(2000).observation.numpy()}
    assert acted and set(acted) <= drawn
    # None was reset for it.
    assert {env.get_attr("resets")[i] for i in range(2)} == {1}


def test_predict_hands_the_frames_on():
    model = tiny(frame_stack=3)
    frames = [np.full((16, 16, 3), value, np.uint8) for value in (10, 20, 30, 40)]
    state, start = None, np.ones(1, bool)
    for frame in frames:
        action, state = model.predict(frame, state, start, deterministic=True)
        start = np.zeros(1, bool)
    assert state[0][0, :, 0, 0, 0].tolist() == [20, 30, 40]
    stack = th.from_numpy(np.stack(frames[1:]).transpose(0, 3, 1, 2)[None])
    agent = model.policy.agent
    expected = agent.actor(agent.encode(stack), th.zeros(())).mean
    assert np.allclose(action, expected.detach().numpy()[0], atol=1e-6)
    _, fresh = model.predict(frames[0], state, np.ones(1, bool), deterministic=True)
    assert fresh[0][0, :, 0, 0, 0].tolist() == [10, 10, 10]


def test_evaluate_policy_is_repeatable():
    model = tiny().learn(30)
    env = vec_env(2)
    first, second = (evaluate_policy(model, env, 4, return_episode_rewards=True) for _ in range(2))
    assert first == second and first[1] == [8] * 4


def test_the_policy_alone_is_saved_and_loaded(tmp_path):
    model = tiny(frame_stack=2, noise_std=0.0)
    model.policy.save(tmp_path / "policy")
    policy = DrQPolicy.load(tmp_path / "policy", device="cpu")
    frame = model.observation_space.sample()
    assert policy.frame_stack == 2 and policy.noise_std == 0
    assert np.array_equal(policy.predict(frame)[0], model.predict(frame)[0])


def test_vectors_have_one_frame_and_images_three():
    vector = spaces.Box(-1, 1, (4,), np.float32)
    assert tiny(CounterEnv(observation_space=vector), "MlpPolicy").policy.frame_stack == 1
    assert tiny().policy.frame_stack == 3
    stacked = tiny(CounterEnv(8, observation_space=vector), "MlpPolicy", frame_stack=2).learn(40)
    assert stacked.policy.agent.encoder.size == 8 and stacked._n_updates > 0


# -- exploration -----------------------------------------------------------------------------------------------------------


def test_noise_falls_as_scheduled_when_acting_and_when_learning():
    model = tiny(noise_std=(1.0, 0.2, 40))
    seen = []

    def look(*_):
        seen.append((model.policy.noise_std, float(model.learner.noise_std)))
        return True

    model.learn(60, callback=look)
    acting = [std for std, _ in seen]
    assert acting[0] == 1.0 and acting[20] == pytest.approx(0.6) and acting[-1] == pytest.approx(0.2)
    assert seen[-1][1] == pytest.approx(0.2)
    model.predict(np.zeros((16, 16, 3), np.uint8))
    assert model.policy.noise_std == pytest.approx(0.2)


@pytest.mark.parametrize("phase", ["pretraining", "finetuning"])
def test_each_phase_begins_with_random_actions(phase):
    model = tiny(intrinsic_reward="disagreement", noise_std=0.0, learning_starts=12)
    if phase == "finetuning":
        model.learn(20)
        model.fine_tune()
    sampled = []
    original = model.action_space.sample
    model.action_space.sample = lambda: sampled.append(model.phase_timesteps) or original()
    model.learn(20)
    assert sampled == list(range(12))


# -- phases ----------------------------------------------------------------------------------------------------------------


def test_the_table_names_every_part_of_the_agent():
    names = set(pretrained().policy.agent.state_dict())
    assert all(name.startswith(tuple(f"{part}." for part in TRANSFER)) for name in names)
    assert TRANSFER["encoder"] == TRANSFER["critic.trunk"] == KEPT and TRANSFER["actor"] == ACTOR_CHOICE


@pytest.mark.parametrize("keep_actor", [None, True, False])
@pytest.mark.parametrize("keep_critic", [True, False])
@pytest.mark.parametrize("through_a_file", [True, False])
def test_transfer(weights, tmp_path, keep_actor, keep_critic, through_a_file):
    model = pretrained(vec_env(domain="jaco"))
    before = parts(model, weights)
    if through_a_file:
        model.save(tmp_path / "snapshot")
        model = DrQv2.load(tmp_path / "snapshot", env=vec_env(domain="jaco"), device="cpu")
    model.fine_tune(keep_actor=keep_actor, keep_critic=keep_critic)
    # The benchmark keeps the actor in every domain.
    kept = {KEPT: True, FRESH: False, ACTOR_CHOICE: keep_actor is not False, CRITIC_CHOICE: keep_critic}
    after = parts(model, weights)
    for name, rule in TRANSFER.items():
        if name not in ("intrinsic", "target_critic"):
            changed = {tensor for tensor in before[name] if before[name][tensor] != after[name][tensor]}
            assert bool(changed) != kept[rule], name
    agent = model.policy.agent
    assert agent.intrinsic is None and weights(agent.critic) == weights(agent.target_critic)
    assert set(model.learner.optimizers()) == {"actor_optimizer", "critic_optimizer"}
    assert not any(optimizer.state_dict()["state"] for optimizer in model.learner.optimizers().values())
    assert model.replay_buffer.size() == 0 and model.phase == "finetuning"
    model.learn(30)


def test_rewards_of_the_task_do_not_reach_a_pre_training_agent(weights):
    def learn(scale, **kwargs):
        return weights(tiny(vec_env(rewards=[scale, -scale]), **kwargs).learn(60).policy)

    assert learn(0.1, intrinsic_reward="disagreement") == learn(5.0, intrinsic_reward="disagreement")
    assert learn(0.1) != learn(5.0)


def test_freeze_encoder_is_for_fine_tuning(weights):
    model = tiny(intrinsic_reward="disagreement", freeze_encoder=True)
    fresh = weights(model.policy.agent.encoder)
    model.learn(40)
    before = weights(model.policy.agent.encoder)
    assert before != fresh
    model.fine_tune()
    critic = weights(model.policy.agent.critic)
    model.learn(40)
    assert weights(model.policy.agent.encoder) == before and weights(model.policy.agent.critic) != critic


@pytest.mark.parametrize("other", [False, True])
def test_switch_within_one_learn(other):
    env = vec_env(2, action_repeat=2)
    target = vec_env(2, action_repeat=3) if other else None
    phases = []
    model = tiny(env, intrinsic_reward="disagreement")
    switch = PhaseSwitchCallback(80, target)
    look = ConvertCallback(lambda *_: phases.append((model.phase, model.phase_frames)) or True)
    model.learn(120, callback=[look, switch])
    assert ("pretraining", 80) in phases and phases[-1][0] == "finetuning"
    assert phases[-1][1] == (120 - 40) * (3 if other else 2) and model.pretrained_frames == 80
    assert model.replay_buffer.phase == "finetuning" and model.phase_updates > 0


def test_a_snapshot_is_fine_tuned_by_callback(tmp_path, weights):
    model = tiny(intrinsic_reward="disagreement")
    model.learn(40, callback=SnapshotCallback(tmp_path, frames=[20, 40]))
    loaded = DrQv2.load(tmp_path / "snapshot_40.zip", env=vec_env(), device="cpu")
    before = weights(loaded.policy.agent.encoder)
    loaded.learn(8, callback=FineTuneCallback(verbose=0))
    assert loaded.phase == "finetuning" and weights(loaded.policy.agent.encoder) == before


class Constant(TransitionReward):
    """A toy method from outside the package.

    :param value: what every step is worth
    """

    def __init__(self, value: float = 2.0):
        super().__init__()
        self.value = value

    def reward(self, steps: EncodedSteps) -> th.Tensor:
        return th.full_like(steps.action[:, 0], self.value)


@pytest.mark.parametrize("method", ["constant", Constant, Constant(2.0)])
def test_a_method_from_outside(monkeypatch, tmp_path, method):
    monkeypatch.delitem(_REGISTRY, "constant", raising=False)
    register_intrinsic_reward("constant", Constant)
    try:
        model = tiny(intrinsic_reward=method).learn(24)
        assert model._metrics.take()["intrinsic_reward"] == 2.0
        model.save(tmp_path / "model")
        assert DrQv2.load(tmp_path / "model", device="cpu").policy.agent.intrinsic.value == 2.0
    finally:
        del _REGISTRY["constant"]


class Own(TransitionReward):
    """Rewards large encodings; loss and reward are handed in."""

    def __init__(self, loss=None, reward=None, trains_encoder=True):
        super().__init__()
        self.trains_encoder = trains_encoder
        if loss is not None:
            self.given_loss = loss
        self.given_reward = reward or (lambda steps: steps.next_encoding.norm(dim=-1))

    def build(self, sizes):
        self.net = th.nn.Linear(sizes.encoding, 1)

    def reward(self, steps):
        return self.given_reward(steps)


class Learning(Own):
    def loss(self, steps):
        return self.given_loss(self, steps)


class Bare(Learning):
    """Without networks of its own."""

    def build(self, sizes):
        pass


@pytest.mark.parametrize(
    ("method", "who"),
    [
        (Own(), "critic"),
        (Own(trains_encoder=False), "critic"),
        (Learning(lambda *_: None), "critic"),
        (Learning(lambda own, steps: (own.net(steps.encoding.detach()).square().mean(), {})), "critic"),
        (Learning(lambda own, steps: (own.net(steps.encoding).square().mean(), {}), trains_encoder=False), "critic"),
        (Learning(lambda own, steps: (own.net(steps.encoding).square().mean(), {})), "method"),
        (Learning(lambda _, steps: (steps.encoding.square().mean(), {})), "method"),
        (Bare(lambda _, steps: (steps.encoding.square().mean(), {})), "method"),
        (Bare(lambda *_: None), "critic"),
    ],
)
def test_the_encoder_learns_from_the_method_or_else_from_the_critic(weights, tmp_path, method, who):
    """And the model is saved, whichever parameters have moments."""
    model = tiny(intrinsic_reward=method, learning_starts=4)
    learner, agent = model.learner, model.policy.agent
    values_seen = []
    original = type(agent.critic).forward

    def spy(critic, encoding, action):
        values_seen.append(encoding.requires_grad)
        return original(critic, encoding, action)

    before = weights(agent.encoder)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(agent.critic), "forward", spy)
        model.learn(24)
    assert any(values_seen) == (who == "critic")
    assert weights(agent.encoder) != before and learner.guard.total() == 0
    with pytest.warns(UserWarning, match="No file can hold this model's intrinsic_reward"):
        model.save(tmp_path / "model")
    loaded = DrQv2.load(tmp_path / "model", env=vec_env(), device="cpu", custom_objects={"intrinsic_reward": method})
    assert loaded.learn(8)._n_updates > model._n_updates


def test_the_critic_trains_an_encoder_that_is_left_to_it_in_the_same_way(weights):
    """The same steps, whichever optimiser holds the encoder."""
    found = [
        weights(tiny(intrinsic_reward=method, learning_starts=4).learn(40).policy.agent.encoder)
        for method in (Own(trains_encoder=False), Own(), Learning(lambda *_: None))
    ]
    assert found[0] == found[1] == found[2]


@pytest.mark.parametrize(
    ("reward", "got"),
    [
        (lambda steps: steps.action[:, :1], r"float32 of the shape \(4, 1\)"),
        (lambda steps: steps.action.mean(), r"float32 of the shape \(\)"),
        (lambda steps: steps.action[:1, 0], r"float32 of the shape \(1,\)"),
        (lambda steps: steps.action[:, 0].long(), r"int64 of the shape \(4,\)"),
        (lambda steps: 1.0, "got float"),
    ],
)
def test_a_reward_of_another_shape_is_refused(reward, got):
    with pytest.raises(ValueError, match=rf"Own.reward must return a float32 tensor of the shape \(B,\) = \(4,\).*{got}"):
        tiny(intrinsic_reward=Own(reward=reward)).learn(24)


@pytest.mark.parametrize(
    ("loss", "message"),
    [
        (lambda own, steps: own.net(steps.encoding).mean(), r"must return None, or .*got torch.float32 of the shape \(\)"),
        (lambda own, steps: (own.net(steps.encoding).mean(0), {}), r"got \(torch.float32 of the shape \(1,\), dict\)"),
        (lambda own, steps: (own.net(steps.encoding).mean(), {"error": 1.0}), "dictionary of scalar tensors"),
        (lambda own, steps: (own.net(steps.encoding).mean().detach(), {}), "depends on nothing that it could train"),
    ],
)
def test_what_is_no_loss_is_refused(loss, message):
    with pytest.raises(ValueError, match=f"Learning.loss .*{message}"):
        tiny(intrinsic_reward=Learning(loss)).learn(24)


def test_a_method_that_forgot_its_base_is_told():
    class Forgetful(Own):
        def __init__(self):
            pass

    with pytest.raises(ValueError, match=r"Forgetful.__init__ must call super\(\).__init__\(\)"):
        tiny(intrinsic_reward=Forgetful)


# -- files and runs --------------------------------------------------------------------------------------------------------


def test_a_file_of_the_other_algorithm_is_refused(tmp_path):
    tiny().save(tmp_path / "drq")
    DreamerV2("CnnPolicy", CounterEnv(), preset="tiny", device="cpu").save(tmp_path / "dreamer")
    for mine, name, its in ((DreamerV2, "drq", "DrQv2"), (DrQv2, "dreamer", "DreamerV2")):
        message = f"{name}.zip is refused: it holds a model of {its}, not of {mine.__name__}: {its}.load reads it"
        with pytest.raises(SnapshotError, match=message):
            mine.load(tmp_path / name, device="cpu")
        with pytest.raises(SnapshotError, match=message):
            mine("CnnPolicy", CounterEnv(), preset="tiny", device="cpu").set_parameters(tmp_path / name)


def test_whose_a_file_is_is_known_where_nobody_imported_that_algorithm(tmp_path):
    tiny().save(tmp_path / "drq")
    code = "import sys; from sb3_dreamer_urlb import DreamerV2; DreamerV2.load(sys.argv[1])"
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "drq"], capture_output=True, text=True, check=False)
    assert done.returncode == 1 and "DrQv2.load reads it" in done.stderr


@pytest.mark.parametrize("other", [{"n_steps": 5}, {"n_steps": 1, "frame_stack": 1}, {"frame_stack": 4, "n_steps": 2}])
def test_a_replay_of_other_stacks_and_returns_is_taken(tmp_path, other):
    model = tiny(vec_env(length=[4, 7])).learn(40)
    model.save_replay_buffer(tmp_path / "replay")
    taker = tiny(vec_env(), **other)
    taker.load_replay_buffer(tmp_path / "replay")
    assert taker.replay_buffer.size() == model.replay_buffer.size()
    frames = taker.replay_buffer.sample(8).observation.shape[1]
    assert frames == taker.policy.frame_stack and taker.learn(20)._n_updates > 0


def test_a_replay_that_does_not_fit_says_why(tmp_path):
    model = tiny(vec_env(length=30), n_steps=2).learn(40)
    model.save_replay_buffer(tmp_path / "replay")
    with pytest.raises(SnapshotError, match="the replay buffer's observation_space is"):
        tiny(vec_env(size=20)).load_replay_buffer(tmp_path / "replay")
    with pytest.raises(SnapshotError, match=r"an episode of 31 rows, the model's replay takes 20 \(buffer_size"):
        tiny(vec_env(), buffer_size=20).load_replay_buffer(tmp_path / "replay")


def test_a_policy_is_loaded_with_its_own_class(tmp_path):
    tiny().policy.save(tmp_path / "drq")
    dreamer = DreamerV2("CnnPolicy", CounterEnv(), preset="tiny", device="cpu")
    dreamer.policy.save(tmp_path / "dreamer")
    with pytest.raises(SnapshotError, match=r"it is one of sb3_dreamer_urlb\.drq_v2\.policies\.DrQPolicy"):
        CnnPolicy.load(tmp_path / "drq")
    with pytest.raises(SnapshotError, match=r"it is one of sb3_dreamer_urlb\.dreamer_v2\.policies\.DreamerPolicy"):
        DrQPolicy.load(tmp_path / "dreamer")


def test_its_policy_is_not_exported(tmp_path):
    model = tiny()
    for given in (model, model.policy):
        with pytest.raises(ValueError, match="ActingStep exports a policy of DreamerV2's"):
            ActingStep(given)
        for write in (to_torchscript, to_onnx):
            with pytest.raises(ValueError, match=r"step must be an ActingStep\(model.policy\)"):
                write(given, tmp_path / "file")


@pytest.mark.parametrize("intrinsic", [None, "disagreement"])
def test_a_resumed_run_goes_on_the_same_way_each_time(tmp_path, weights, intrinsic):
    keep = {"every_frames": 16, "handle_signals": False}
    model = tiny(intrinsic_reward=intrinsic).learn(40, RunCheckpointCallback(tmp_path / "run", **keep))
    found = []
    for number in range(2):
        folder = shutil.copytree(tmp_path / "run", tmp_path / str(number))
        resumed = DrQv2.resume(folder, vec_env(), device="cpu")
        assert weights(resumed.policy) == weights(model.policy) and resumed.replay_buffer.size() > 0
        assert resumed.num_timesteps == 40 and resumed._n_updates == model._n_updates
        resumed.learn(40, RunCheckpointCallback(folder, **keep), reset_num_timesteps=False)
        found.append(weights(resumed.policy))
    assert found[0] == found[1] != weights(model.policy)


def test_overlap_changes_nothing(weights):
    assert weights(tiny(overlap=True).learn(60).policy) == weights(tiny(overlap=False).learn(60).policy)


def test_the_store_on_the_device_changes_nothing(weights):
    def learn(store):
        return weights(tiny(replay_buffer_kwargs={"store": store}).learn(40).policy)

    assert learn("memory") == learn("device")


def test_a_run_that_no_longer_learns_ends(tmp_path):
    with pytest.raises(NumericalFaultError, match="critic"):
        tiny(vec_env(rewards=[3e38]), tensorboard_log=str(tmp_path), train_freq=1).learn(200)


def test_an_environment_without_end_is_learnt_from_as_soon_as_it_is_due():
    model = tiny(vec_env(length=10**9)).learn(40)
    assert model._n_updates == tiny(vec_env(length=8)).learn(40)._n_updates > 0
