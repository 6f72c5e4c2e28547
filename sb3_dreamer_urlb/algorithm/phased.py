"""What every agent of this package is as an algorithm of Stable-Baselines3: it learns in two phases, and nothing gets lost."""

from __future__ import annotations

import os
from abc import abstractmethod
from contextlib import ExitStack
from typing import Any, TypeVar

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_dreamer_urlb import phases, transfer_rule
from sb3_dreamer_urlb.algorithm import advice, checks, normalized, training_loop
from sb3_dreamer_urlb.algorithm.environment_checks import needed_env
from sb3_dreamer_urlb.algorithm.environments import EnvironmentAlgorithm
from sb3_dreamer_urlb.algorithm.updates_due import UpdatesDue
from sb3_dreamer_urlb.devices import chosen_device
from sb3_dreamer_urlb.envs import broken_rules
from sb3_dreamer_urlb.envs.faults import EnvironmentFaultError
from sb3_dreamer_urlb.envs.registration import naming_near_ids
from sb3_dreamer_urlb.intrinsic import ExplorationMethod
from sb3_dreamer_urlb.learning.numerical_faults import NumericalFaultError, UpdateGuard
from sb3_dreamer_urlb.number_checks import check_dict, plain
from sb3_dreamer_urlb.runs.last_state import save_last_good_state
from sb3_dreamer_urlb.runs.resuming import resume_if_asked
from sb3_dreamer_urlb.signatures import answering_unknown_keywords
from sb3_dreamer_urlb.snapshots.saved_algorithm import builds_networks
from sb3_dreamer_urlb.types import MetricMeans
from sb3_dreamer_urlb.unknown_names import did_you_mean

SelfPhasedAlgorithm = TypeVar("SelfPhasedAlgorithm", bound="PhasedAlgorithm")


class PhasedAlgorithm(EnvironmentAlgorithm):
    """An off-policy algorithm that pre-trains with an intrinsic reward and fine-tunes on a task (paper §2, §3).

    The base of every algorithm here, as Stable-Baselines3's ``OffPolicyAlgorithm`` is of SAC. Here is what
    does not depend on how an agent learns: phases and their counters, ``learn``, faults.
    A subclass says, in the order in which they happen:

    - :meth:`_prepare`: what follows from the arguments before anything is built;
    - :meth:`_new_replay_buffer`, :meth:`_new_policy`, :meth:`_build`: the parts of the current phase;
    - ``_sample_action``, SB3's: how it acts while it learns; :meth:`_replayed_beside` what the replay keeps of that;
    - ``train``, SB3's: the updates;
    - :meth:`_transfer`: what a fine-tuning agent takes over.

    :param policy: name or class
    :param env: environment, vectorised or not, or its id
    :param learning_rate: a number or a schedule
    :param intrinsic_reward: what the pre-training explores with; None to learn the task at once
    :param verbose: 0 quiet, 1 info, 2 debug
    :param overlap: let environments in other processes step while an update runs
    :param preset: name of the set of hyperparameters that filled in what the caller left out
    :param kwargs: of SB3's ``OffPolicyAlgorithm``
    """

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule,
        *,
        intrinsic_reward: str | type[ExplorationMethod] | ExplorationMethod | None,
        verbose: int,
        overlap: bool,
        preset: str,
        **kwargs: Any,
    ):
        checks.check_verbose(verbose)
        kwargs["device"] = chosen_device(kwargs.get("device", "auto"))
        for name in ("policy_kwargs", "replay_buffer_kwargs"):
            # Stable-Baselines3 takes whatever is false for an empty one.
            check_dict(name, kwargs.get(name))
        with naming_near_ids(str(env)):
            super().__init__(policy, env, learning_rate, verbose=verbose, support_multi_env=True, sde_support=False, **kwargs)
        self.intrinsic_reward = intrinsic_reward
        self.overlap = overlap
        self.preset = preset
        #: name of the phase; with its own counters, which ``learn`` never resets
        self.phase = phases.FINETUNING if intrinsic_reward is None else phases.PRETRAINING
        self.phase_timesteps = 0
        self.phase_updates = 0
        #: environment frames seen in the phase: agent steps × action repeat
        self.phase_frames = 0
        #: environment frames of the pre-training that this model was fine-tuned from
        self.pretrained_frames = 0
        #: what its fine-tuning began with, see :meth:`fine_tune`; None before, without pre-training, and of older files
        self.kept = None
        #: skipped updates of what this model was before, in the other phase or in a file
        self._skipped_before = 0
        #: environment frames an agent step
        self.action_repeat = 1
        #: of the environment's task, None where it does not tell
        self.domain = None
        #: ``<domain>-<task>`` whose rewards it has learnt from last; None before
        self.learnt_task = None
        #: faults that environments' guards reported so far
        self.env_faults = 0
        self.run_folder = None
        self.checkpoint = None
        self.during_learn = ExitStack()
        #: of the updates since the last line of the log
        self._metrics = MetricMeans()
        self._logged_phase: str | None = None

    # -- set-up --------------------------------------------------------------------------------------------------------

    def _setup_model(self) -> None:
        if not builds_networks():
            return
        self._prepare()
        self.set_random_seed(self.seed)
        self._build()

    def _prepare(self) -> None:
        # Paths as snapshots can hold them.
        path = self.replay_buffer_kwargs.get("path")
        if isinstance(path, os.PathLike):
            self.replay_buffer_kwargs = {**self.replay_buffer_kwargs, "path": os.fspath(path)}
        if isinstance(self.tensorboard_log, os.PathLike):
            self.tensorboard_log = os.fspath(self.tensorboard_log)
        self._setup_lr_schedule()
        self._convert_train_freq()
        self._read_env()

    def _get_policy_from_name(self, policy_name: str) -> type[BasePolicy]:
        if policy_name not in self.policy_aliases:
            dicts = f": {type(self).__name__} takes no Dict observations" if policy_name == "MultiInputPolicy" else ""
            meant = "" if dicts else did_you_mean([policy_name], self.policy_aliases)
            raise ValueError(f"Unknown policy {policy_name!r}; known are {sorted(self.policy_aliases)}{dicts}.{meant}")
        return self.policy_aliases[policy_name]

    def set_random_seed(self, seed: int | None = None) -> None:
        """As SB3's, which takes no numpy number."""
        super().set_random_seed(plain(seed))

    @property
    def skipped_updates(self) -> int:
        """Updates so far, in both phases, that were skipped because a loss or gradient was not finite."""
        guard = self._guard()
        return self._skipped_before + (0 if guard is None else guard.total())

    @skipped_updates.setter
    def skipped_updates(self, count: int) -> None:
        # As of a file, before anything is built.
        self._skipped_before = count

    @abstractmethod
    def _guard(self) -> UpdateGuard | None:
        """What counts the present optimisers' skipped updates; None before there are any."""

    # -- phases --------------------------------------------------------------------------------------------------------

    def __setattr__(self, name: str, value: Any) -> None:
        """As ever.

        :raises AttributeError: for another phase, which only :meth:`fine_tune` makes
        """
        if name == "phase" and "policy" in vars(self) and value != self.phase:
            raise AttributeError(
                f"phase cannot be assigned, got {value!r}: the networks are those of {self.phase!r}. fine_tune() leaves the "
                "pre-training."
            )
        super().__setattr__(name, value)

    @answering_unknown_keywords
    def fine_tune(
        self,
        env: GymEnv | str | None = None,
        keep_actor: bool | None = None,
        keep_critic: bool = False,
        keep_reward: bool = False,
    ) -> None:
        """Leave pre-training: what the transfer keeps stays, everything else starts afresh (paper §3).

        The usual research flow: load a pre-trained snapshot, call this, ``learn`` the task.

        :param env: the fine-tuning environment or its id; None stays in the same one
        :param keep_actor: None asks :meth:`keeps_actor`
        :param keep_critic: for ablations
        :param keep_reward: for agents that have one: begin with the task's reward head as the pre-training's rewards taught it
            (paper, appendix "Learning Rewards Online"): of this environment's task, if the pre-training learnt several by name
            (``learn_task_reward``), else that of the *pre-training* environment's task
        :raises ValueError: if the model is not pre-training, there is no such head, or one of these is neither true nor false
        """
        keep_actor, keep_critic, keep_reward = plain((keep_actor, keep_critic, keep_reward))
        checks.check_kept(keep_actor, keep_critic, keep_reward)
        checks.check_pretrains(self)
        self.take_over_changes()
        if env is not None:
            env = self.prepare_fine_tuning_env(env)
        if keep_reward:
            self._check_reward_is_known(self.env if env is None else env)
        advice.warn_if_nothing_was_learnt(self)
        if env is not None:
            before = self._vec_normalize_env
            self.set_env(env)
            normalized.carry_over(before, self._vec_normalize_env)
        if keep_actor is None:
            keep_actor = self.keeps_actor()
        pretrained = self.policy
        vars(self)["phase"] = phases.FINETUNING
        self.pretrained_frames = self.phase_frames
        self.kept = {"actor": bool(keep_actor), "critic": bool(keep_critic), "reward": bool(keep_reward)}
        self.phase_timesteps, self.phase_frames, self.phase_updates = 0, 0, 0
        self.replay_buffer.close()
        del self.replay_buffer
        self._build()
        self._transfer(pretrained, keep_actor, keep_critic, keep_reward)
        self._last_obs = None

    def keeps_actor(self) -> bool:
        """Whether fine-tuning keeps the actor where nobody says: the paper's task-aware rule, where rewards are dense, not
        for jaco.
        """
        return transfer_rule.keeps_actor(self.domain)

    def prepare_fine_tuning_env(self, env: GymEnv | str) -> VecEnv:
        """As :meth:`prepare_env`; also checks that the pre-trained model will be shown what it knows.

        :param env: vectorised or not, or its id
        :raises ValueError: if it does not fit
        """
        wrapped = self.prepare_env(env)
        if self.env is not None:
            normalized.check(self._vec_normalize_env, unwrap_vec_normalize(wrapped))
        return wrapped

    def _check_reward_is_known(self, env: VecEnv | None) -> None:
        """
        :param env: of the fine-tuning
        :raises ValueError: if the pre-training has learnt no reward head of the task
        """
        raise ValueError(f"keep_reward=True needs a reward head, and {type(self).__name__} has none.")

    @abstractmethod
    def _transfer(self, pretrained: BasePolicy, keep_actor: bool, keep_critic: bool, keep_reward: bool) -> None:
        """Take over from the pre-trained policy what fine-tuning keeps; the model's own is fresh.

        :param pretrained: of the same sizes
        :param keep_actor: whether the actor is kept
        :param keep_critic: whether the critic is kept
        :param keep_reward: whether the task's reward head is kept
        """

    # -- learning ------------------------------------------------------------------------------------------------------

    @answering_unknown_keywords
    def learn(
        self: SelfPhasedAlgorithm,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "run",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfPhasedAlgorithm:
        """Collect and learn for ``total_timesteps`` agent steps; as SB3's, but warm-ups count by phase, not by call.

        :param total_timesteps: agent steps; where a ``RunCheckpointCallback(..., resume="auto")`` goes on with a run, of the
            whole run
        :param callback: SB3 callback(s)
        :param log_interval: episodes between two log lines
        :param tb_log_name: name of the TensorBoard run
        :param reset_num_timesteps: restart ``num_timesteps``; the phase's own counters go on in any case
        :param progress_bar: show one
        :raises ValueError: for what is no number of steps or episodes, or no callback
        :raises MissingEnvironmentError: if the model was loaded without an environment
        :raises EnvironmentFaultError: if an environment is given up on; the last good state is saved then
        :raises NumericalFaultError: if losses or gradients stay non-finite; likewise
        """
        total_timesteps, log_interval = plain(total_timesteps), plain(log_interval)
        reset_num_timesteps, progress_bar = plain(reset_num_timesteps), plain(progress_bar)
        checks.check_learn(
            total_timesteps, log_interval, callback, reset_num_timesteps=reset_num_timesteps, progress_bar=progress_bar
        )
        needed_env(self, "learn")
        self.take_over_changes()
        with self.during_learn:
            if resume_if_asked(self, callback):
                total_timesteps, reset_num_timesteps = max(total_timesteps - self.num_timesteps, 0), False
            total_timesteps, callbacks = self._setup_learn(
                total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
            )
            callbacks.on_training_start(locals(), globals())
            due = UpdatesDue(self, total_timesteps)
            try:
                training_loop.learn(self, total_timesteps, callbacks, log_interval, due.paced(self._update), self.overlap)
            except (EnvironmentFaultError, NumericalFaultError) as error:
                raise type(error)(f"{error} {save_last_good_state(self)}") from error
            due.ended()
            callbacks.on_training_end()
            return self

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        if self.env is not None and self._was_touched():
            self._last_obs = None
        if reset_num_timesteps or self._last_obs is None:
            # The environments are about to be reset.
            self.replay_buffer.close_streams()
            self._last_obs = None
        try:
            result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        except broken_rules.RAISED as error:
            if self._last_obs is None:
                broken_rules.annotate(error, "reset")
            raise
        if self.run_folder is not None:
            self.run_folder.restore_normalization(self.get_vec_normalize_env(), self.restart_episodes)
        self._logged_phase = None
        return result

    def _init_callback(self, callback: MaybeCallback, progress_bar: bool = False) -> BaseCallback:
        # SB3 has just reset the environments; callbacks may touch them.
        self._begin_episodes()
        return super()._init_callback(callback, progress_bar)

    def _update(self, collected: int, ahead: int) -> None:
        """The updates after, or within the last step of, one rollout.

        :param collected: agent steps of the rollout
        :param ahead: agent steps that are under way, and not yet counted in ``num_timesteps``
        """
        # SB3 gates on num_timesteps, which every learn() resets.
        if self.phase_timesteps <= self.learning_starts:
            return
        self._update_current_progress_remaining(self.num_timesteps + ahead, self._total_timesteps)
        self.train(self.gradient_steps if self.gradient_steps >= 0 else collected, self.batch_size)
        self.policy.set_training_mode(False)

    def dump_logs(self) -> None:
        """Write the log; the only place where metrics leave the device."""
        for name, value in self._metrics.take().items():
            self.logger.record(f"train/{name}", value)
        self.logger.record("train/skipped_updates", self.skipped_updates)
        self.logger.record("rollout/env_faults", self.env_faults)
        # TensorBoard shows texts one by one: once a phase will do.
        self.logger.record("time/phase", self.phase, exclude="tensorboard" if self.phase == self._logged_phase else None)
        self._logged_phase = self.phase
        self.logger.record("time/phase_frames", self.phase_frames)
        self.logger.record("time/total_frames", self.num_timesteps * self.action_repeat)
        super().dump_logs()
