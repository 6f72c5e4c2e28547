"""Runs that are cut off and go on, and all of a model that must then be the same."""

from __future__ import annotations

import os
import random
import subprocess

import numpy as np
import pytest
import torch as th
from fake_envs import CounterEnv
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

LENGTH = 20


class RepeatingEnv(CounterEnv):
    """Every episode is the same, so that a reset forgets nothing."""

    def reset(self, **kwargs):
        self.frames = 0
        return super().reset(**kwargs)


def vec_env(n_envs=1, length=LENGTH, **kwargs):
    return DummyVecEnv([lambda: Monitor(RepeatingEnv(length, **kwargs))] * n_envs)


def everything(model) -> dict[str, object]:
    """All that a run is made of: weights, moments, counters, replay, random states."""
    buffer = model.replay_buffer
    episodes = [b"".join(rows.tobytes() for rows in e.rows(0, len(e)).values()) for e in buffer.episodes]
    return {
        "weights": {name: value.numpy().tobytes() for name, value in model.policy.state_dict().items()},
        "moments": {
            (name, index, key): value.numpy().tobytes()
            for name, optimizer in model.learner.optimizers().items()
            for index, state in optimizer.state_dict()["state"].items()
            for key, value in state.items()
        },
        "counters": [model.num_timesteps, model.phase, model.phase_timesteps, model.phase_updates, model._n_updates],
        "episodes": episodes,
        "replay": [buffer.evicted, buffer.finished_count, buffer.longest, buffer.finished_rows],
        "torch": th.get_rng_state().numpy().tobytes(),
        "numpy": str(np.random.get_state()),  # noqa: NPY002
        "python": random.getstate(),
        "sampler": str(buffer.rng.bit_generator.state),
        "action_space": str(model.action_space.np_random.bit_generator.state),
    }


def scramble():
    """What another process would begin with."""
    th.manual_seed(99), np.random.seed(99), random.seed(99)  # noqa: NPY002


class SmallDisk:
    """A disk of 1 MB, mounted."""

    def __init__(self, folder):
        self.folder = folder / "disk"
        self.folder.mkdir()
        mount = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(self.folder)]
        if subprocess.run(mount, capture_output=True).returncode != 0:
            pytest.skip("only root can mount a small disk")

    def fill(self):
        free = os.statvfs(self.folder)
        (self.folder / "filler").write_bytes(b"x" * (free.f_bavail * free.f_bsize - 40_000))

    def free(self):
        (self.folder / "filler").unlink(missing_ok=True)

    def close(self):
        subprocess.run(["umount", str(self.folder)], check=True)


class StopAt(BaseCallback):
    """Ends ``learn`` as a crash would."""

    def __init__(self, steps):
        super().__init__()
        self.steps = steps

    def _on_step(self):
        if self.num_timesteps >= self.steps:
            raise ZeroDivisionError
        return True


def crash(model, steps, total, callbacks):
    with pytest.raises(ZeroDivisionError):
        model.learn(total, callback=[*callbacks, StopAt(steps)])
