"""The training loop: act, update while the environments step, keep what they gave.

The updates of a rollout come after its last action is chosen and before that step's rows are kept: act, update, step, as in
the authors' own loop. So an environment in another process can step and render while the learner works, and since neither
needs the other, it makes no difference to either whether they take turns (``overlap=False``) or not: the same transitions,
batches and weights, bit for bit. Compared with SB3's order (act, step, update), the same weights choose every action; an
episode that ends with a rollout's last step is drawn from the next updates on.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper
from stable_baselines3.common.vec_env.base_vec_env import VecEnvObs, VecEnvStepReturn

from sb3_dreamer_urlb.envs.broken_rules import asking_to


class LearningVecEnv(VecEnvWrapper):
    """Environments in whose last step of a rollout the learner works.

    :param venv: the environments
    :param update: what to do in that step; told the rollout's agent steps, and how many of them are still under way
    :param overlap: do it after the actions are sent and before results are waited for; otherwise before they are sent
    """

    def __init__(self, venv: VecEnv, update: Callable[[int, int], None], overlap: bool):
        super().__init__(venv)
        self.update, self.overlap = update, overlap
        self.steps = 0
        self.left: int | None = None

    def begin(self, steps: int | None) -> LearningVecEnv:
        """A rollout begins.

        :param steps: it has; None where nobody knows, so that no update can come before its last step ends
        :return: self
        """
        self.steps = (steps or 0) * self.num_envs
        self.left = steps
        return self

    def reset(self) -> VecEnvObs:
        """As the environments'."""
        return self.venv.reset()

    def step_async(self, actions: np.ndarray) -> None:
        """Send the actions."""
        if self.left is not None:
            self.left -= 1
        if self.left == 0 and not self.overlap:
            self.update(self.steps, self.num_envs)
        self.venv.step_async(actions)

    def step_wait(self) -> VecEnvStepReturn:
        """:raises Exception: of the update, which comes first, or of the environments"""
        if self.left == 0 and self.overlap:
            try:
                self.update(self.steps, self.num_envs)
            except BaseException:
                # Or the next question to a process would get the answer to this one.
                with suppress(Exception):
                    self.venv.step_wait()
                raise
        with asking_to("step"):
            return self.venv.step_wait()


def learn(
    model: OffPolicyAlgorithm,
    total_timesteps: int,
    callbacks: BaseCallback,
    log_interval: int,
    update: Callable[[int, int], None],
    overlap: bool,
) -> None:
    """Collect and update until the steps are done, or a callback ends it.

    :param model: set up by SB3's ``_setup_learn``
    :param total_timesteps: value of ``num_timesteps`` to reach
    :param callbacks: told as SB3 tells them
    :param log_interval: episodes between two log lines
    :param update: the updates of one rollout; told its agent steps, and how many of them are still under way
    :param overlap: let the environments step meanwhile
    """
    env: LearningVecEnv | None = None
    while model.num_timesteps < total_timesteps:
        assert model.env is not None and model.replay_buffer is not None and isinstance(model.train_freq, TrainFreq)
        # In each round: a callback may have assigned another one.
        frequency, unit = model.train_freq
        steps = frequency if unit == TrainFrequencyUnit.STEP else None
        if env is None or env.venv is not model.env:
            # At first, and when a callback brought other environments.
            env = LearningVecEnv(model.env, update, overlap)
        rollout = model.collect_rollouts(
            env.begin(steps),
            callbacks,
            model.train_freq,
            model.replay_buffer,
            model.action_noise,
            model.learning_starts,
            log_interval,
        )
        if not rollout.continue_training:
            break
        if steps is None:
            # Which step is an episode's last is known afterwards.
            update(rollout.episode_timesteps, 0)
