"""The callbacks that turn a run from pre-training to fine-tuning (paper §3 "Task-aware fine-tuning")."""

from __future__ import annotations

import warnings

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import GymEnv

from sb3_dreamer_urlb.algorithm import PhasedAlgorithm
from sb3_dreamer_urlb.algorithm.checks import check_kept
from sb3_dreamer_urlb.callbacks.best import forget_best
from sb3_dreamer_urlb.callbacks.placing import BetweenRolloutsCallback
from sb3_dreamer_urlb.number_checks import is_integer, plain
from sb3_dreamer_urlb.phases import PRETRAINING
from sb3_dreamer_urlb.signatures import WithKnownKeywords


class PhaseSwitchCallback(WithKnownKeywords, BetweenRolloutsCallback):
    """Turn a run from pre-training to fine-tuning inside one ``model.learn(...)``.

    The switch happens at the end of the rollout in which the phase's frames are reached, unless ``learn`` ends with it:
    then the model stays pre-trained, and the next ``learn`` begins with the switch. It depends only on the model's own phase
    and frame counter, which snapshots carry: repeated ``learn`` calls and resets are harmless. Evaluations begin a new search
    for the best model then, also those of Stable-Baselines3's ``EvalCallback``.

    :param pretrain_frames: length of the pre-training in environment frames (agent steps × action repeat)
    :param env: the fine-tuning environment or its id; None stays in the same one
    :param keep_actor: None decides by the task (paper §3): kept for walker and quadruped, dropped for jaco
    :param keep_critic: for ablations
    :param keep_reward: begin with the task's reward head of the pre-training, see ``fine_tune``
    :param verbose: 1 prints the switch
    :raises ValueError: for a number of frames that is not positive, or a choice that is neither true nor false; and, when
        ``learn`` begins, for an ``env`` that does not fit the model
    """

    def __init__(
        self,
        pretrain_frames: int = 2_000_000,
        env: GymEnv | str | None = None,
        keep_actor: bool | None = None,
        keep_critic: bool = False,
        verbose: int = 0,
        keep_reward: bool = False,
    ):
        super().__init__(verbose)
        pretrain_frames = plain(pretrain_frames)
        if not is_integer(pretrain_frames) or pretrain_frames < 1:
            raise ValueError(f"pretrain_frames must be a positive integer, got {pretrain_frames!r}.")
        self.pretrain_frames = pretrain_frames
        self.env = env
        self.keep_actor, self.keep_critic, self.keep_reward = kept = plain((keep_actor, keep_critic, keep_reward))
        check_kept(*kept)
        #: close the environments that nobody needs any more, where nobody else holds them
        self.closes_pretraining = False

    def _init_callback(self) -> None:
        model: PhasedAlgorithm = self.model  # type: ignore[assignment]
        if model.intrinsic_reward is None and model.phase != PRETRAINING:
            warnings.warn(
                "PhaseSwitchCallback has nothing to switch: with intrinsic_reward=None the model learns the task at once."
            )
        # Now, not after the 2M frames of pre-training.
        if self.env is not None:
            self.env = model.prepare_fine_tuning_env(self.env) if model.phase == PRETRAINING else model.prepare_env(self.env)
        if self.keep_reward and model.phase == PRETRAINING:
            model._check_reward_is_known(self.env or model.env)
        if self.env is None:
            return
        resumed = model.run_folder is not None and model.run_folder.resumed
        if resumed and model.phase != PRETRAINING and model.get_env() is not self.env:
            # The run was resumed after the switch, with the pre-training's environment.
            model.set_env(self.env)
            model.restart_episodes()

    def _on_step(self) -> bool:
        return True

    def _on_training_start(self) -> None:
        # A learn() before this one, perhaps in another process, ended with the pre-training.
        self._switch_if_due()
        model: PhasedAlgorithm = self.model  # type: ignore[assignment]
        end = model.phase_frames + (model._total_timesteps - model.num_timesteps) * model.action_repeat
        if model.phase == PRETRAINING and end < self.pretrain_frames:
            warnings.warn(
                f"This learn() will not reach the fine-tuning: it ends after {end} frames of pre-training, and "
                f"PhaseSwitchCallback switches after pretrain_frames={self.pretrain_frames}."
            )

    def _on_rollout_end(self) -> None:
        # Between rollouts, because a rollout holds on to its environment and replay buffer. If no step is left for the
        # task, the pre-trained agent is what the caller wants to have.
        if self.model.num_timesteps < self.model._total_timesteps:
            self._switch_if_due()

    def _switch_if_due(self) -> None:
        model: PhasedAlgorithm = self.model  # type: ignore[assignment]
        if model.phase != PRETRAINING or model.phase_frames < self.pretrain_frames:
            return
        if self.verbose >= 1:
            print(f"Pre-training ends after {model.phase_frames} frames; fine-tuning begins.")
        before = model.get_env()
        model.fine_tune(self.env, self.keep_actor, self.keep_critic, self.keep_reward)
        model.restart_episodes()
        forget_best(self.locals.get("callbacks"))
        if self.closes_pretraining and before is not None and before is not model.get_env():
            before.close()


class FineTuneCallback(WithKnownKeywords, BaseCallback):
    """Fine-tune a pre-trained snapshot from the first step of ``learn`` on: ``model.fine_tune()`` for configuration files.

    A model that is fine-tuning already, because its run was cut off, goes on.

    :param keep_actor: None decides by the task (paper §3): kept for walker and quadruped, dropped for jaco
    :param keep_critic: for ablations
    :param keep_reward: begin with the task's reward head of the pre-training, see ``fine_tune``
    :param verbose: 1 prints what is fine-tuned
    :raises ValueError: for a choice that is neither true nor false; and, when ``learn`` begins, for a model that was not
        pre-trained
    """

    def __init__(self, keep_actor: bool | None = None, keep_critic: bool = False, verbose: int = 1, keep_reward: bool = False):
        super().__init__(verbose)
        self.keep_actor, self.keep_critic, self.keep_reward = kept = plain((keep_actor, keep_critic, keep_reward))
        check_kept(*kept)

    def _on_step(self) -> bool:
        return True

    def _on_training_start(self) -> None:
        model: PhasedAlgorithm = self.model  # type: ignore[assignment]
        if model.phase_timesteps == 0 and (model.phase == PRETRAINING or model.intrinsic_reward is None):
            raise ValueError(
                "FineTuneCallback needs a pre-trained model, this one has seen 0 frames: "
                f"load a snapshot with {type(model).__name__}.load, or with rl_zoo3's -i."
            )
        if model.phase != PRETRAINING:
            return
        if self.verbose >= 1:
            print(f"Fine-tuning what {model.phase_frames} frames of pre-training with {model.intrinsic_reward!r} left.")
        model.fine_tune(keep_actor=self.keep_actor, keep_critic=self.keep_critic, keep_reward=self.keep_reward)
        model.restart_episodes()
