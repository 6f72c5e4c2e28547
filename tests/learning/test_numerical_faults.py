"""Losses and gradients that are not finite: skipped, counted, and the end of a run that does nothing else."""

from __future__ import annotations

import copy
import math
import re

import pytest
import torch as th
from fake_envs import CounterEnv
from stable_baselines3.common.callbacks import ConvertCallback
from stable_baselines3.common.logger import KVWriter, Logger
from torch.utils._python_dispatch import TorchDispatchMode

from sb3_dreamer_urlb import DreamerV2, IntrinsicReward, NumericalFaultError, RunCheckpointCallback
from sb3_dreamer_urlb.intrinsic.registry import registered_intrinsic_rewards
from sb3_dreamer_urlb.learning.numerical_faults import MAX_IN_A_ROW
from sb3_dreamer_urlb.learning.optim import ClippedAdam


def with_skill(learner, batch):
    """A batch whose rows followed skills, where the method has them."""
    skills = learner.agent.skills
    if skills is not None:
        batch.skill = skills.sample(batch.reward.numel()).view(*batch.reward.shape, -1)
    return batch


def spoilt(batch, value=math.nan):
    """The batch with one bad action, which reaches every state after it."""
    bad = copy.deepcopy(batch)
    bad.action[1, 2, 0] = value
    return bad


# -- the optimiser ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("where", ["loss", "gradient"])
def test_a_bad_step_changes_neither_weights_nor_moments(seeded, value, where):
    network = th.nn.Linear(3, 1)
    optimizer = ClippedAdam(network.parameters(), 0.01, 1e-5, 1.0, 1e-3)
    inputs = th.randn(4, 3)
    optimizer.step(network(inputs).square().sum())
    twin = copy.deepcopy(network)
    its = ClippedAdam(twin.parameters(), 0.01, 1e-5, 1.0, 1e-3)
    its.load_state_dict(copy.deepcopy(optimizer.state_dict()))
    # sqrt has an infinite slope at 0, and a finite value.
    slope = (network.weight - network.weight.detach()).sum() * (0 if math.isnan(value) else math.copysign(1, value))
    loss = network(inputs).sum()
    optimizer.step(loss + value if where == "loss" else loss + slope.abs().sqrt())
    assert optimizer.skipped
    for parameter, other in zip(network.parameters(), twin.parameters(), strict=True):
        assert th.equal(parameter, other) and optimizer.adam.state[parameter]["step"] == 1
    # And the next one steps as if nothing had been; that one was skipped is known until somebody has asked.
    for net, one in ((network, optimizer), (twin, its)):
        one.step(net(inputs).square().sum())
    assert optimizer.skipped and th.equal(network.weight, twin.weight)
    optimizer.skipped = None
    for net, one in ((network, optimizer), (twin, its)):
        one.step(net(inputs).square().sum())
    assert not optimizer.skipped and th.equal(network.weight, twin.weight)


# -- an update -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", [None, *registered_intrinsic_rewards()])
def test_a_bad_batch_changes_nothing(learner, batch, weights, method):
    trainer = learner(method)
    with_skill(trainer, batch)
    for _ in range(2):
        trainer.update(batch)
    before = weights(trainer.agent)
    trainer.update(spoilt(batch))
    after = weights(trainer.agent)
    # RND's own loss reads the images alone, which are good.
    own = ("intrinsic.predictor.",) if method == "rnd" else ()
    assert {name for name in before if before[name] != after[name] and not name.startswith(own)} == set()
    assert trainer.guard.total() == 1 and trainer.guard.skipped.any()
    trainer.update(batch)
    assert trainer.guard.total() == 1 and not trainer.guard.skipped.any()
    final = weights(trainer.agent)
    assert all(value.isfinite().all() for value in trainer.agent.state_dict().values())
    assert any(final[name] != before[name] for name in before if name.startswith("world_model.rssm"))


def test_only_the_part_whose_loss_is_bad_is_skipped(learner, batch, weights, monkeypatch):
    trainer = learner()
    monkeypatch.setattr(trainer.agent.critic, "loss", lambda value, target, weight: value.sum() * math.nan)
    before = weights(trainer.agent)
    trainer.update(batch)
    after = weights(trainer.agent)
    changed = {name.split(".")[0] for name in before if before[name] != after[name]}
    assert {"world_model", "actor"} <= changed and "critic" not in changed
    assert trainer.guard.skipped.tolist() == [name == "critic_optimizer" for name in trainer.optimizers()]


def test_the_slow_critic_stays_finite(learner, batch):
    trainer = learner(target_update_interval=1)
    trainer.update(spoilt(batch))
    assert all(value.isfinite().all() for value in trainer.agent.slow_critic.state_dict().values())


class Transfers(TorchDispatchMode):
    """Counts what asks the device for a value."""

    def __init__(self):
        super().__init__()
        self.seen = []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        if "_local_scalar_dense" in str(function) or "nonzero" in str(function):
            self.seen.append(str(function))
        return function(*args, **(kwargs or {}))


@pytest.mark.parametrize("method", [None, "lbs", "rnd"])
def test_an_update_never_waits_for_the_device(learner, batch, method):
    trainer = learner(method)
    with Transfers() as transfers:
        trainer.update(batch)
        trainer.update(spoilt(batch))
        assert transfers.seen == []
        trainer.guard.total()
    assert len(transfers.seen) == 1  # else the count above could not fail


@pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU")
def test_on_a_gpu_a_bad_batch_changes_nothing(learner, batch, weights):
    trainer = learner("lbs")
    agent = trainer.agent.to("cuda")
    trainer = type(trainer)(agent, trainer.config)
    batch = type(batch)(*(None if part is None else part.cuda() for part in vars(batch).values()))
    trainer.update(batch)
    before = weights(agent)
    bad = spoilt(batch)
    th.cuda.set_sync_debug_mode("error")
    try:
        trainer.update(bad)
    finally:
        th.cuda.set_sync_debug_mode("default")
    assert weights(agent) == before and trainer.guard.total() == 1
    trainer.update(batch)
    assert weights(agent) != before


# -- a run -----------------------------------------------------------------------------------------------------------------


def spoil(model, first, last):
    """Make the updates from ``first`` to before ``last`` bad."""
    original, calls = model.learner.update, 0

    def update(batch):
        nonlocal calls
        calls += 1
        return original(spoilt(batch) if first < calls <= last else batch)

    model.learner.update = update


class Collected(KVWriter):
    def __init__(self):
        self.rows = []

    def write(self, key_values, key_excluded, step=0):
        self.rows.append(dict(key_values))


def test_single_bad_updates_are_counted_in_the_log(tiny_model):
    model = tiny_model()
    spoil(model, 5, 8)
    collected = Collected()
    model.set_logger(Logger(None, [collected]))
    model.learn(200, log_interval=1)
    counts = [row["train/skipped_updates"] for row in collected.rows]
    assert counts[0] == 0 and counts[-1] == 3 and counts == sorted(counts)
    assert all(value.isfinite().all() for value in model.policy.state_dict().values())


def test_just_too_few_in_a_row_go_on(tiny_model):
    model = tiny_model(train_freq=1)
    spoil(model, 10, 10 + MAX_IN_A_ROW - 1)
    model.learn(200)
    assert model._n_updates > 2 * MAX_IN_A_ROW and model.learner.guard.total() == MAX_IN_A_ROW - 1


def test_many_in_a_row_end_the_run_with_a_snapshot(tiny_model, tmp_path):
    model = tiny_model(train_freq=1, tensorboard_log=str(tmp_path), seed=3)
    spoil(model, 10, 10**9)
    last_good = {}

    def remember(local, _):
        if model.phase_updates == 10:
            last_good.update(copy.deepcopy(model.policy.state_dict()))
        return True

    with pytest.raises(NumericalFaultError, match="the model and the actor and the critic was not finite") as caught:
        model.learn(1000, callback=ConvertCallback(remember))
    assert 10 + MAX_IN_A_ROW <= model._n_updates <= 10 + 2 * MAX_IN_A_ROW
    [path] = re.findall(r"The last good state is in (\S+\.zip)\.", str(caught.value))
    assert path.startswith(str(tmp_path))
    loaded = DreamerV2.load(path, env=CounterEnv(), device="cpu")
    assert last_good and all(th.equal(value, last_good[name]) for name, value in loaded.policy.state_dict().items())
    loaded.learn(40, reset_num_timesteps=False)
    assert loaded._n_updates > model._n_updates


class Broken(IntrinsicReward):
    """Divides by zero."""

    def reward(self, imagination, reward_head):
        return imagination.feature[..., 0] / 0


def test_a_reward_that_is_no_number_is_named(tiny_model):
    """The model learns on; the behaviour does not, and what it is paid with may be why."""
    model = tiny_model(train_freq=1, intrinsic_reward=Broken())
    before = copy.deepcopy(model.policy.agent.world_model.state_dict())
    with pytest.raises(NumericalFaultError, match=r"of the actor and the critic was not finite. The intrinsic reward Broken"):
        model.learn(1000)
    after = model.policy.agent.world_model.state_dict()
    assert not all(th.equal(value, before[name]) for name, value in after.items())


@pytest.mark.parametrize("overlap", [True, False])
def test_with_a_run_folder_the_last_good_state_is_its_checkpoint(tiny_model, tmp_path, overlap):
    """The step that was under way during the last update is neither in it nor counted."""
    model = tiny_model(CounterEnv(action_repeat=2), train_freq=1, overlap=overlap)
    spoil(model, 10, 10**9)
    with pytest.raises(NumericalFaultError, match=f"The last good state is in {tmp_path}"):
        model.learn(1000, callback=RunCheckpointCallback(tmp_path))
    assert model.checkpoint is None
    resumed = DreamerV2.resume(tmp_path, CounterEnv(action_repeat=2), device="cpu")
    assert resumed.num_timesteps == model.num_timesteps and resumed.replay_buffer.size() > 0
    assert resumed.phase_timesteps == resumed.num_timesteps and resumed.phase_frames == 2 * resumed.num_timesteps
    rows = sum(len(episode) - 1 for episode in resumed.replay_buffer.episodes)
    assert rows == resumed.num_timesteps  # one a step, besides each episode's first
    resumed.learn(40, reset_num_timesteps=False)
    assert resumed.learner.guard.total() == 0


def test_a_last_good_state_that_cannot_be_written(tiny_model, tmp_path):
    model = tiny_model(train_freq=1, tensorboard_log=str(tmp_path))
    spoil(model, 0, 10**9)
    model.save = lambda path: (_ for _ in ()).throw(OSError(28, "No space left on device"))
    with pytest.raises(NumericalFaultError, match=r"could not be written: .*No space left"):
        model.learn(1000)
