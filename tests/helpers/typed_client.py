"""A program that uses the public names, as mypy sees it in strict form (``make type``). Nobody runs it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import VecEnv
from typing_extensions import assert_type

from sb3_dreamer_urlb import (
    CnnPolicy,
    DreamerPolicy,
    DreamerV2,
    FineTuneCallback,
    IntrinsicReward,
    NumericalFaultError,
    PhaseSwitchCallback,
    PlannerConfig,
    RunCheckpointCallback,
    SequenceReplayBuffer,
    SnapshotCallback,
    SnapshotError,
    register_envs,
    register_intrinsic_reward,
)
from sb3_dreamer_urlb.envs import FaultGuard, make_supervised_vec_env, make_urlb_env
from sb3_dreamer_urlb.intrinsic.base import RewardHead
from sb3_dreamer_urlb.types import Imagination, Metrics, ModelSizes, Posterior, SequenceBatch


class Own(IntrinsicReward):
    """Reward large features."""

    def __init__(self, gain: float = 1.0) -> None:
        super().__init__()
        self.gain = gain

    def build(self, sizes: ModelSizes) -> None:
        self.scale = th.nn.Parameter(th.ones(sizes.feature))

    def loss(self, posterior: Posterior, batch: SequenceBatch) -> tuple[th.Tensor, Metrics] | None:
        loss = self.scale.square().mean()
        return loss, {"scale": loss.detach()}

    def reward(self, imagination: Imagination, reward_head: RewardHead) -> th.Tensor:
        return self.gain * (imagination.feature * self.scale).mean(-1)


class OwnModel(DreamerV2):
    """Classes of users keep their type."""


def train(folder: Path) -> DreamerV2:
    register_envs()
    register_intrinsic_reward("own", Own)
    env: gymnasium.Env[Any, Any] = FaultGuard(make_urlb_env("walker", "stand"))
    workers = make_supervised_vec_env("urlb/walker-stand-v0", n_envs=2)
    assert_type(workers, VecEnv)
    model = DreamerV2(
        "CnnPolicy",
        env,
        learning_rate=lambda progress: 3e-4 * progress,
        intrinsic_reward=Own,
        intrinsic_kwargs={"gain": 2.0},
        planner="dyna_mpc",
        planner_kwargs=vars(PlannerConfig(n_samples=64)),
        seed=0,
    )
    callbacks: list[BaseCallback] = [
        RunCheckpointCallback(folder),
        SnapshotCallback(folder / "snapshots", frames=[1000]),
        PhaseSwitchCallback(1000, env=workers),
        FineTuneCallback(keep_actor=False),
    ]
    try:
        assert_type(model.learn(1000, callback=callbacks, progress_bar=True), DreamerV2)
    except NumericalFaultError:
        model.fine_tune(env, keep_actor=True)
    return model


def use(model: DreamerV2, folder: Path) -> None:
    assert_type(model.policy, DreamerPolicy)
    assert_type(model.replay_buffer, SequenceReplayBuffer)
    assert_type(model.phase, str)
    assert_type(model.phase_frames, int)
    observation = np.zeros((3, 64, 64), np.uint8)
    action, state = model.predict(observation, None, np.ones(1, bool), deterministic=True)
    assert_type(action, np.ndarray)
    assert_type(state, tuple[np.ndarray, ...] | None)
    evaluate_policy(model, FaultGuard(make_urlb_env("walker", "run")), n_eval_episodes=1)
    model.save(folder / "model")
    model.save_replay_buffer(folder / "replay")
    model.policy.save(folder / "policy.zip")


def come_back(folder: Path) -> DreamerV2:
    try:
        assert_type(OwnModel.load(folder / "model", device="cpu"), OwnModel)
        assert_type(CnnPolicy.load(folder / "policy.zip"), CnnPolicy)
    except SnapshotError as error:
        print(error)
    assert_type(OwnModel.resume(folder), OwnModel | None)
    return DreamerV2.load(folder / "model").learn(100, reset_num_timesteps=False)
