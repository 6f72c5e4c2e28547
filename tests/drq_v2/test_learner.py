"""One update against a reference that shares nothing with it but the weights it begins with."""

from __future__ import annotations

import numpy as np
import pytest
import torch as th
import torch.nn.functional as F
from gymnasium import spaces

from sb3_dreamer_urlb.drq_v2.agent import DrQAgent
from sb3_dreamer_urlb.drq_v2.learner import DrQLearner, DrQLearnerConfig
from sb3_dreamer_urlb.intrinsic import Disagreement
from sb3_dreamer_urlb.spaces.observations import Images, Numbers
from sb3_dreamer_urlb.types import StepBatch

B, STACK, IMAGE, ACTIONS = 6, 2, (3, 20, 18), 2
RATE, TAU, STD, CLIP, PAD = 1e-3, 0.05, 0.4, 0.3, 4
ENSEMBLE = 3


def make_learner(intrinsic=None, images=True, **kwargs):
    th.manual_seed(0)
    space = spaces.Box(0, 255, IMAGE, np.uint8) if images else spaces.Box(-1, 1, (4,), np.float32)
    observations = Images(space) if images else Numbers(space)
    agent = DrQAgent(observations, ACTIONS, STACK, 3, 5, [7, 8], intrinsic)
    # Targets that are not the critic, or nobody would see which of the two is read.
    with th.no_grad():
        for parameter in agent.target_critic.parameters():
            parameter.add_(0.1 * th.randn(parameter.shape))
    config = {"learning_rate": RATE, "adam_eps": 1e-8, "max_grad_norm": np.inf, "tau": TAU, "noise_clip": CLIP}
    learner = DrQLearner(agent, DrQLearnerConfig(**{**config, "freeze_encoder": False, **kwargs}))
    learner.set_noise(STD)
    return learner


def make_batch(images=True, seed=1):
    generator = th.Generator().manual_seed(seed)
    shape = (B, STACK, *IMAGE) if images else (B, STACK, 4)

    def observation():
        if images:
            return th.randint(0, 256, shape, generator=generator, dtype=th.uint8)
        return th.rand(shape, generator=generator)

    reward = th.rand(B, generator=generator)
    discount = th.tensor([0.97, 0.97, 0.0, 0.98, 0.99, 0.97])
    action = 2 * th.rand(B, ACTIONS, generator=generator) - 1
    return StepBatch(observation(), action, reward, discount, observation())


class Reference:
    """DrQ-v2's update in plain functions of named tensors, with an optimiser for each of encoder, actor and critic."""

    def __init__(self, agent, images, encoder_learns=True):
        self.images = images
        self.w = {name: value.detach().clone().requires_grad_() for name, value in agent.state_dict().items()}
        parts = {
            part: [v for n, v in self.w.items() if n.split(".")[0] == part]
            for part in ("encoder", "actor", "critic", "intrinsic")
        }
        if not encoder_learns:
            del parts["encoder"]
        self.adam = {name: th.optim.Adam(values, lr=RATE) for name, values in parts.items() if values}

    def shifted(self, frames, offsets):
        if not self.images:
            return frames.flatten(1)
        out = []
        for image, down, right in zip(frames.numpy(), *offsets.tolist(), strict=True):
            stack = image.reshape(-1, *IMAGE[1:])
            padded = np.pad(stack, ((0, 0), (PAD, PAD), (PAD, PAD)), mode="edge")
            out.append(padded[:, down : down + IMAGE[1], right : right + IMAGE[2]])
        return th.from_numpy(np.stack(out)).float() / 255 - 0.5

    def encode(self, x):
        if not self.images:
            return x
        for i, stride in enumerate((2, 1, 1, 1)):
            x = F.conv2d(x, self.w[f"encoder.convs.{i}.weight"], self.w[f"encoder.convs.{i}.bias"], stride).relu()
        return x.reshape(B, -1)

    def layers(self, x, name):
        count = sum(key.startswith(f"{name}.dense.") for key in self.w) // 2
        for i in range(count):
            x = x @ self.w[f"{name}.dense.{i}.weight"].T + self.w[f"{name}.dense.{i}.bias"]
            x = x.relu() if i < count - 1 else x
        return x

    def trunk(self, x, name):
        x = x @ self.w[f"{name}.trunk.0.weight"].T + self.w[f"{name}.trunk.0.bias"]
        return F.layer_norm(x, x.shape[-1:], self.w[f"{name}.trunk.1.weight"], self.w[f"{name}.trunk.1.bias"]).tanh()

    def act(self, encoding, noise):
        mean = self.layers(self.trunk(encoding, "actor"), "actor.body").tanh()
        action = mean + (STD * noise).clip(-CLIP, CLIP)
        return action + (action.clip(-1 + 1e-6, 1 - 1e-6) - action).detach()

    def values(self, encoding, action, name):
        x = th.cat([self.trunk(encoding, name), action], 1)
        return self.layers(x, f"{name}.heads.0")[:, 0], self.layers(x, f"{name}.heads.1")[:, 0]

    def step(self, loss, *parts):
        for part in self.adam.values():
            part.zero_grad()
        loss.backward()
        for part in parts:
            if part in self.adam:
                self.adam[part].step()

    def update(self, batch, intrinsic_trains_encoder=None):
        """With the draws that the learner makes, in its order.

        :param intrinsic_trains_encoder: None without an intrinsic reward
        """
        first, then = ((th.randint(0, 2 * PAD + 1, (2, B)) if self.images else None) for _ in range(2))
        encoding = self.encode(self.shifted(batch.observation, first))
        with th.no_grad():
            following = self.encode(self.shifted(batch.next_observation, then))
        reward = batch.reward
        if intrinsic_trains_encoder is not None:
            inputs = th.cat([encoding if intrinsic_trains_encoder else encoding.detach(), batch.action], 1)
            guesses = [self.layers(inputs, f"intrinsic.models.{k}") for k in range(ENSEMBLE)]
            loss = sum(((guess - following) ** 2).sum(1).sqrt().mean() for guess in guesses) / ENSEMBLE
            self.step(loss, "intrinsic", *(("encoder",) if intrinsic_trains_encoder else ()))
            with th.no_grad():
                inputs = inputs.detach()
                guesses = np.stack([self.layers(inputs, f"intrinsic.models.{k}").numpy() for k in range(ENSEMBLE)])
                reward = th.from_numpy(guesses.var(0, ddof=1).mean(1))
            if intrinsic_trains_encoder:
                encoding = encoding.detach()
        with th.no_grad():
            next_action = self.act(following, th.randn(B, ACTIONS))
            target = reward + batch.discount * th.minimum(*self.values(following, next_action, "target_critic"))
        one, two = self.values(encoding, batch.action, "critic")
        critic_loss = F.mse_loss(one, target) + F.mse_loss(two, target)
        self.step(critic_loss, "critic", *(() if intrinsic_trains_encoder else ("encoder",)))
        encoding = encoding.detach()
        actor_loss = -th.minimum(*self.values(encoding, self.act(encoding, th.randn(B, ACTIONS)), "critic")).mean()
        self.step(actor_loss, "actor")
        with th.no_grad():
            for name, value in self.w.items():
                if name.startswith("target_critic"):
                    value.copy_((1 - TAU) * value + TAU * self.w[name.removeprefix("target_")])
        return {"critic_loss": critic_loss.item(), "actor_loss": actor_loss.item(), "reward": reward.mean().item()}


def compare(learner, reference, batches, trains=None):
    for number, batch in enumerate(batches):
        th.manual_seed(number)
        found = learner.update(batch)
        th.manual_seed(number)
        expected = reference.update(batch, trains)
        assert {name: found[name].item() for name in expected} == pytest.approx(expected, rel=1e-4, abs=1e-6)
    for name, value in learner.agent.state_dict().items():
        assert th.allclose(value, reference.w[name], rtol=1e-4, atol=1e-5), name


@pytest.mark.parametrize("images", [True, False])
def test_golden_update_on_a_task(images):
    learner = make_learner(images=images)
    compare(learner, Reference(learner.agent, images), [make_batch(images, seed) for seed in (1, 2, 3)])


@pytest.mark.parametrize("images", [True, False])
@pytest.mark.parametrize("trains_encoder", [True, False])
def test_golden_update_of_disagreement(images, trains_encoder):
    learner = make_learner(Disagreement(ENSEMBLE, trains_encoder), images)
    compare(learner, Reference(learner.agent, images), [make_batch(images, seed) for seed in (1, 2)], trains_encoder)


def test_a_frozen_encoder_stays():
    learner = make_learner(freeze_encoder=True)
    before = {name: value.clone() for name, value in learner.agent.state_dict().items()}
    compare(learner, Reference(learner.agent, True, encoder_learns=False), [make_batch()])
    after = learner.agent.state_dict()
    assert all(th.equal(before[name], after[name]) for name in before if name.startswith("encoder."))
    assert not th.equal(before["critic.trunk.0.weight"], after["critic.trunk.0.weight"])


def test_the_actors_loss_leaves_encoder_and_critic_alone():
    learner = make_learner()
    before = {name: value.clone() for name, value in learner.agent.state_dict().items()}
    learner._update_actor(learner.agent.encode(make_batch().observation).detach())
    changed = {name.split(".")[0] for name, value in learner.agent.state_dict().items() if not th.equal(value, before[name])}
    assert changed == {"actor"}


@pytest.mark.parametrize("part", ["reward", "discount", "action"])
def test_a_batch_that_is_not_finite_teaches_nothing(part):
    learner, batch = make_learner(), make_batch()
    before = {name: value.clone() for name, value in learner.agent.state_dict().items()}
    getattr(batch, part)[0] = np.nan
    learner.update(batch)
    assert learner.guard.total() == 1
    after = learner.agent.state_dict()
    assert all(value.isfinite().all() for value in after.values())
    assert all(th.equal(after[name], value) for name, value in before.items() if name.startswith(("encoder", "critic")))


def test_disagreement_falls_where_the_ensemble_has_learnt():
    learner, batch = make_learner(Disagreement(ENSEMBLE), learning_rate=3e-3, freeze_encoder=True), make_batch()
    rewards = [learner.update(batch)["intrinsic_reward"].item() for _ in range(60)]
    assert np.mean(rewards[-10:]) < 0.5 * np.mean(rewards[:10])
