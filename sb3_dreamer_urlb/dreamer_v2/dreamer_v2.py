"""DreamerV2 as a Stable-Baselines3 algorithm: SB3's contract, nothing of the model."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import FloatSchedule

from sb3_dreamer_urlb import native, phases
from sb3_dreamer_urlb.behavior.actor_critic import AUTO, choose_gradient
from sb3_dreamer_urlb.callbacks import checkpoint as run_checkpoints
from sb3_dreamer_urlb.dreamer_v2 import arguments, training_loop, transfer
from sb3_dreamer_urlb.dreamer_v2.acting import ActingAlgorithm
from sb3_dreamer_urlb.dreamer_v2.policies import ActingState, CnnPolicy, DreamerPolicy, MlpPolicy, MultiInputPolicy
from sb3_dreamer_urlb.dreamer_v2.presets import with_preset
from sb3_dreamer_urlb.dreamer_v2.saving import SavingAlgorithm
from sb3_dreamer_urlb.envs.faults import EnvironmentFaultError
from sb3_dreamer_urlb.intrinsic import IntrinsicReward, SkillReward, make_intrinsic_reward
from sb3_dreamer_urlb.learning import graphs, numerical_faults
from sb3_dreamer_urlb.learning.learner import Learner, LearnerConfig
from sb3_dreamer_urlb.planning import make_planner
from sb3_dreamer_urlb.replay import SequenceReplayBuffer
from sb3_dreamer_urlb.runs.last_state import save_last_good_state
from sb3_dreamer_urlb.runs.run_folder import RunFolder
from sb3_dreamer_urlb.spaces.actions import make_actions
from sb3_dreamer_urlb.types import MetricMeans

SelfDreamerV2 = TypeVar("SelfDreamerV2", bound="DreamerV2")


class DreamerV2(ActingAlgorithm, SavingAlgorithm):
    """DreamerV2 with unsupervised pre-training, task-aware fine-tuning and Dyna-MPC.

    "Mastering the Unsupervised Reinforcement Learning Benchmark from Pixels" (ICML 2023). With an ``intrinsic_reward``
    the model starts in the *pre-training* phase: the environment's rewards are logged but drive nothing. Without one it
    learns the task at once. :meth:`fine_tune`, or a :class:`~sb3_dreamer_urlb.PhaseSwitchCallback`, moves on to
    fine-tuning. All defaults are the paper's.

    Units: ``learning_starts``, ``train_freq``, ``planner_delay`` and ``buffer_size`` count *agent steps*, as everywhere in
    SB3; ``phase_frames`` counts environment frames (agent steps × action repeat), as in the paper.

    :param policy: ``"CnnPolicy"`` for images, ``"MlpPolicy"`` for vectors, ``"MultiInputPolicy"`` for a Dict of both
    :param env: environment, vectorised or not, or its id; Box, Discrete or MultiDiscrete actions
    :param learning_rate: of the world model and the intrinsic reward; a number or a schedule
    :param actor_learning_rate: number or schedule
    :param critic_learning_rate: number or schedule
    :param buffer_size: rows of replay to keep
    :param learning_starts: agent steps in each phase before its first update
    :param batch_size: B, sequences a batch
    :param batch_length: T, rows a sequence
    :param imagination_horizon: H, steps dreamt from every replayed state
    :param gamma: discount factor
    :param gae_lambda: λ of the returns
    :param train_freq: update after this many steps (of the vectorised environment)
    :param gradient_steps: updates each time; -1 for as many as steps were taken
    :param intrinsic_reward: ``"icm"``, ``"plan2explore"``, ``"rnd"``, ``"lbs"``, ``"apt"``, ``"diayn"``, ``"aps"``,
        ``"random"``, another registered name, a subclass or an instance of
        :class:`~sb3_dreamer_urlb.IntrinsicReward`, or None to learn the task
    :param intrinsic_kwargs: hyperparameters of the intrinsic reward, for a name or a class
    :param skill_selection_starts: agent steps of fine-tuning before a skill is chosen (DIAYN, APS); until then only the
        world model learns
    :param planner: ``"dyna_mpc"``, ``"mppi"`` or None; acts in fine-tuning, also in ``predict``
    :param planner_kwargs: fields of :class:`~sb3_dreamer_urlb.PlannerConfig`
    :param planner_delay: agent steps after ``learning_starts`` until the planner takes over from the actor
    :param ent_coef: weight of the actor's entropy; None: 0 while exploring, 1e-4 on a task
    :param free_nats: the KL that costs nothing
    :param kl_balance: share of the KL's gradient that trains the prior
    :param kl_scale: weight of the KL in the model's loss
    :param actor_gradient: ``"dynamics"``: through the model, straight through where actions are one-hot; ``"reinforce"``: by
        the score function, for Discrete and MultiDiscrete actions; ``"auto"``: REINFORCE for these, dynamics for Box (as
        DreamerV2)
    :param target_update_interval: updates between two copies of the critic to the slow critic
    :param adam_eps: ε of all optimisers
    :param max_grad_norm: bound of each optimiser's gradient norm
    :param weight_decay: every weight is multiplied by (1 − this) in each step
    :param discount_head: learn which states terminate; None: yes unless the environment says that it never does
    :param action_noise: SB3's, added to actions while training
    :param replay_buffer_class: None for :class:`~sb3_dreamer_urlb.SequenceReplayBuffer`, or a subclass of it
    :param replay_buffer_kwargs: further arguments of it
    :param policy_kwargs: sizes of the networks, see :class:`~sb3_dreamer_urlb.DreamerPolicy`
    :param stats_window_size: episodes that rollout statistics average over
    :param tensorboard_log: folder of TensorBoard logs
    :param verbose: 0 quiet, 1 info, 2 debug
    :param seed: of everything random
    :param device: "auto", "cpu", "cuda"
    :param precision: of matrix products and convolutions: ``"float32"``, ``"bfloat16"``, or ``"auto"`` for whichever is
        faster on this machine at this size; losses, statistics and weights are float32 in any case
    :param overlap: let environments in other processes step while an update runs; the result is the same, bit for bit. False
        lets them take turns
    :param compile: how updates and actions run: ``"eager"``, operation by operation with torch's kernels; ``"native"``, on
        CPUs, with kernels of our own where they are faster, which a C++ compiler on this machine builds in a second, once;
        ``"cuda_graphs"``, recorded once and launched as a whole; ``"auto"``: CUDA graphs on CUDA, native on CPUs where that
        can be had. What cannot be recorded or built runs eager, after a warning that says why; a compiler that is missing is
        worth a warning with ``"native"`` only
    :param preset: ``"paper"``, ``"small"`` (pixels on two CPU cores), ``"vector"`` (vectors on one) or ``"tiny"`` (tests);
        replaces defaults, never what you write
    :param _init_setup_model: build the networks now
    :raises ValueError: for arguments or spaces that do not fit, before anything is built
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "CnnPolicy": CnnPolicy,
        "MlpPolicy": MlpPolicy,
        "MultiInputPolicy": MultiInputPolicy,
    }
    policy_class: type[DreamerPolicy]

    @with_preset
    def __init__(
        self,
        policy: str | type[DreamerPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 3e-4,
        actor_learning_rate: float | Schedule = 8e-5,
        critic_learning_rate: float | Schedule = 8e-5,
        buffer_size: int = 1_000_000,
        learning_starts: int = 2000,
        batch_size: int = 50,
        batch_length: int = 50,
        imagination_horizon: int = 15,
        gamma: float = 0.99,
        gae_lambda: float = 0.95,
        train_freq: int | tuple[int, str] = 5,
        gradient_steps: int = 1,
        intrinsic_reward: str | type[IntrinsicReward] | IntrinsicReward | None = None,
        intrinsic_kwargs: dict[str, Any] | None = None,
        skill_selection_starts: int = 2000,
        planner: str | None = None,
        planner_kwargs: dict[str, Any] | None = None,
        planner_delay: int = 500,
        ent_coef: float | None = None,
        free_nats: float = 1.0,
        kl_balance: float = 0.8,
        kl_scale: float = 1.0,
        actor_gradient: str = AUTO,
        target_update_interval: int = 100,
        adam_eps: float = 1e-5,
        max_grad_norm: float = 100.0,
        weight_decay: float = 1e-6,
        discount_head: bool | None = None,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[SequenceReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        precision: str = "auto",
        overlap: bool = True,
        compile: str = "auto",
        preset: str = "paper",
        _init_setup_model: bool = True,
    ):
        arguments.check_verbose(verbose)
        super().__init__(
            policy,
            env,
            learning_rate,
            buffer_size,
            learning_starts,
            batch_size,
            gamma=gamma,
            train_freq=train_freq,
            gradient_steps=gradient_steps,
            action_noise=action_noise,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            support_multi_env=True,
            seed=seed,
            sde_support=False,
        )
        self.actor_learning_rate = actor_learning_rate
        self.critic_learning_rate = critic_learning_rate
        self.batch_length = batch_length
        self.imagination_horizon = imagination_horizon
        self.gae_lambda = gae_lambda
        self.intrinsic_reward = intrinsic_reward
        self.intrinsic_kwargs = intrinsic_kwargs
        self.skill_selection_starts = skill_selection_starts
        self.planner = planner
        self.planner_kwargs = planner_kwargs
        self.planner_delay = planner_delay
        self.ent_coef = ent_coef
        self.free_nats = free_nats
        self.kl_balance = kl_balance
        self.kl_scale = kl_scale
        self.actor_gradient = actor_gradient
        self.target_update_interval = target_update_interval
        self.adam_eps = adam_eps
        self.max_grad_norm = max_grad_norm
        self.weight_decay = weight_decay
        self.discount_head = discount_head
        self.precision = precision
        self.overlap = overlap
        self.compile = compile
        self.preset = preset

        #: name of the phase; with its own counters, which ``learn`` never resets
        self.phase = phases.FINETUNING if intrinsic_reward is None else phases.PRETRAINING
        self.phase_timesteps = 0
        self.phase_updates = 0
        #: environment frames seen in the phase: agent steps × action repeat
        self.phase_frames = 0
        #: environment frames of the pre-training that this model was fine-tuned from
        self.pretrained_frames = 0
        self._logged_phase: str | None = None
        #: environment frames an agent step
        self.action_repeat = 1
        #: faults that environments' guards reported so far
        self.env_faults = 0
        self._skipped_before = 0
        #: of the environment's task, None where it does not tell
        self.domain: str | None = None
        #: where the run is kept, None unless a RunCheckpointCallback does
        self.run_folder: RunFolder | None = None
        #: writes a checkpoint of the run now and returns its folder; None unless a RunCheckpointCallback is at work
        self.checkpoint: Callable[[], Path] | None = None
        #: what callbacks want undone when ``learn`` ends, however it ends
        self.during_learn = ExitStack()

        if _init_setup_model:
            self._setup_model()

    # -- set-up --------------------------------------------------------------------------------------------------------

    def _setup_model(self) -> None:
        self._prepare()
        self.set_random_seed(self.seed)
        self._build()

    def _prepare(self) -> None:
        """Everything of the set-up that builds nothing yet."""
        arguments.check(self)
        # Paths as snapshots can hold them.
        path = self.replay_buffer_kwargs.get("path")
        if isinstance(path, os.PathLike):
            self.replay_buffer_kwargs = {**self.replay_buffer_kwargs, "path": os.fspath(path)}
        if isinstance(self.tensorboard_log, os.PathLike):
            self.tensorboard_log = os.fspath(self.tensorboard_log)
        self._setup_lr_schedule()
        self._actor_lr_schedule = FloatSchedule(self.actor_learning_rate)
        self._critic_lr_schedule = FloatSchedule(self.critic_learning_rate)
        graphs.warn_if_in_vain(self.compile, self.device)
        self._convert_train_freq()
        self._read_env()

    def _build(self) -> None:
        """Fresh networks, optimisers and replay for the current phase."""
        intrinsic = self._intrinsic()
        self.skill_size = 0 if intrinsic is None or intrinsic.skills is None else intrinsic.skills.dim
        if getattr(self, "replay_buffer", None) is None:
            self.replay_buffer = self._new_replay_buffer()
        self._skipped_before = self.skipped_updates
        self.policy = self._new_policy(intrinsic).to(self.device)
        self.learner = Learner(self.policy.agent, self._learner_config(intrinsic))
        self.learner.updates = self.phase_updates
        if self.verbose >= 1:
            print(f"Products of updates in {self.learner.dtype}, of the planner in {self.policy.planner_dtype}")
            print(f"Kernels: {native.describe(self.compile, self.device)}")
            print(f"Replay in the store {self.replay_buffer.store!r}")
        self._acting_state: ActingState | None = None
        self._metrics = MetricMeans()

    def _new_policy(self, intrinsic: IntrinsicReward | None) -> DreamerPolicy:
        return self.policy_class(
            self.observation_space,
            self.action_space,
            self.lr_schedule,
            gamma=self.gamma,
            discount_head=bool(self.discount_head),
            intrinsic=intrinsic,
            explores=phases.PHASES[self.phase].explores,
            planner=make_planner(self.planner, self.planner_kwargs, self.gae_lambda, make_actions(self.action_space).classes),
            precision=self.precision,
            compile=self.compile,
            **self.policy_kwargs,
        )

    def _intrinsic(self) -> IntrinsicReward | None:
        """What the current phase explores with; fine-tuning keeps only what has skills."""
        intrinsic = make_intrinsic_reward(self.intrinsic_reward, self.intrinsic_kwargs)
        if intrinsic is not None and intrinsic.skills is None and not phases.PHASES[self.phase].explores:
            return None
        return intrinsic

    def _learner_config(self, intrinsic: IntrinsicReward | None) -> LearnerConfig:
        return LearnerConfig(
            learning_rate=self.lr_schedule(1),
            actor_learning_rate=self._actor_lr_schedule(1),
            critic_learning_rate=self._critic_lr_schedule(1),
            adam_eps=self.adam_eps,
            max_grad_norm=self.max_grad_norm,
            weight_decay=self.weight_decay,
            free_nats=self.free_nats,
            kl_balance=self.kl_balance,
            kl_scale=self.kl_scale,
            actor_gradient=choose_gradient(self.actor_gradient, make_actions(self.action_space).classes),
            imagination_horizon=self.imagination_horizon,
            gae_lambda=self.gae_lambda,
            target_update_interval=self.target_update_interval,
            ent_coef=phases.phase_ent_coef(self.phase, intrinsic, self.ent_coef),
            reward_trains_model=not phases.PHASES[self.phase].explores,
            precision=self.precision,
            compile=self.compile,
        )

    def _new_replay_buffer(self) -> SequenceReplayBuffer:
        buffer_class: Any = self.replay_buffer_class or SequenceReplayBuffer
        buffer: SequenceReplayBuffer = buffer_class(
            self.buffer_size,
            self.observation_space,
            self.action_space,
            device=self.device,
            n_envs=self.n_envs,
            **{
                "batch_length": self.batch_length,
                "seed": self.seed,
                "phase": self.phase,
                "skill_size": self.skill_size,
                **self.replay_buffer_kwargs,
            },
        )
        return buffer

    def _get_policy_from_name(self, policy_name: str) -> type[BasePolicy]:
        if policy_name not in self.policy_aliases:
            raise ValueError(f"Unknown policy {policy_name!r}; known are {sorted(self.policy_aliases)}.")
        return self.policy_aliases[policy_name]

    @property
    def skipped_updates(self) -> int:
        """Updates so far, in both phases, that were skipped because a loss or gradient was not finite."""
        learner: Learner | None = getattr(self, "learner", None)
        return self._skipped_before + (0 if learner is None else learner.guard.total())

    @skipped_updates.setter
    def skipped_updates(self, count: int) -> None:
        # As of a file, before there is a learner.
        self._skipped_before = count

    # -- phases --------------------------------------------------------------------------------------------------------

    def fine_tune(self, env: GymEnv | None = None, keep_actor: bool | None = None, keep_critic: bool = False) -> None:
        """Leave pre-training: what ``transfer.TRANSFER`` keeps stays, everything else starts afresh (paper §3).

        The usual research flow: load a pre-trained snapshot, call this, ``learn`` the task.

        :param env: the fine-tuning environment; None stays in the same one
        :param keep_actor: None decides by the task: kept where rewards are dense, dropped for jaco
        :param keep_critic: for ablations
        :raises ValueError: if the model is not pre-training
        """
        if self.phase != phases.PRETRAINING:
            raise ValueError(f"fine_tune() needs a model in the phase {phases.PRETRAINING!r}, this one is in {self.phase!r}.")
        if env is not None:
            self.set_env(env)
        if keep_actor is None:
            keep_actor = phases.keeps_actor(self.domain)
        pretrained = self.policy.agent
        self.phase, self.pretrained_frames = phases.FINETUNING, self.phase_frames
        self.phase_timesteps, self.phase_frames, self.phase_updates = 0, 0, 0
        self.replay_buffer.close()
        del self.replay_buffer
        self._build()
        transfer.transfer(pretrained, self.policy.agent, keep_actor, keep_critic)
        self._last_obs = None

    def fix_skill(self, skill: int | np.ndarray | None) -> None:
        """Follow one skill from now on, in training as in ``predict`` (DIAYN, APS).

        :param skill: float (W,), or the number of a one-hot skill; None draws random ones again, and lets fine-tuning choose
        :raises ValueError: if the method has no skills, or this is none of them
        """
        skills = self.policy.agent.skills
        if skills is None:
            raise ValueError(f"intrinsic_reward={self.intrinsic_reward!r} has no skills.")
        skills.fix(skills.numbered(int(skill)) if isinstance(skill, int | np.integer) else skill)

    def _choose_skill(self) -> None:
        """Choose the skill that serves the task best (spec/algorithms §6)."""
        agent = self.policy.agent
        if not isinstance(agent.intrinsic, SkillReward) or agent.explores:
            return
        sequences = -(-max(transfer.SKILL_STATES, self.batch_size * self.batch_length) // self.batch_length)
        batch = self.replay_buffer.sample(sequences, env=self._vec_normalize_env)
        model = agent.world_model
        with th.no_grad():
            posterior = model.observe(model.preprocess(batch.observation), batch.action, batch.is_first)
            agent.intrinsic.skills.fix(agent.intrinsic.choose_skill(agent.actor, posterior, batch))

    # -- learning ------------------------------------------------------------------------------------------------------

    def learn(
        self: SelfDreamerV2,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "DreamerV2",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfDreamerV2:
        """Collect and learn for ``total_timesteps`` agent steps; as SB3's, but warm-ups count by phase, not by call.

        :param total_timesteps: agent steps; where a ``RunCheckpointCallback(..., resume="auto")`` goes on with a run, of the
            whole run
        :param callback: SB3 callback(s)
        :param log_interval: episodes between two log lines
        :param tb_log_name: name of the TensorBoard run
        :param reset_num_timesteps: restart ``num_timesteps``; the phase's own counters go on in any case
        :param progress_bar: show one
        :raises EnvironmentFaultError: if an environment is given up on; the last good state is saved then
        :raises NumericalFaultError: if losses or gradients stay non-finite; likewise
        """
        with self.during_learn:
            if run_checkpoints.resume_if_asked(self, callback):
                total_timesteps, reset_num_timesteps = max(total_timesteps - self.num_timesteps, 0), False
            total_timesteps, callbacks = self._setup_learn(
                total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
            )
            callbacks.on_training_start(locals(), globals())
            try:
                training_loop.learn(self, total_timesteps, callbacks, log_interval)
            except (EnvironmentFaultError, numerical_faults.NumericalFaultError) as error:
                raise type(error)(f"{error} {save_last_good_state(self)}") from error
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
        if reset_num_timesteps or self._last_obs is None:
            # The environments are about to be reset.
            self.replay_buffer.close_streams()
        result = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        if self.run_folder is not None:
            self.run_folder.restore_normalization(self)
        self._logged_phase = None
        if self._vec_normalize_env is not None:
            self._last_original_obs = self._original_obs(self._vec_normalize_env)
        return result

    def train(self, gradient_steps: int, batch_size: int) -> None:
        """Update on replayed sequences; does nothing while no finished episode is long enough.

        :param gradient_steps: number of updates
        :param batch_size: B
        :raises NumericalFaultError: if losses or gradients stay non-finite
        """
        if not self.replay_buffer.can_sample():
            arguments.check_episode_length(self.replay_buffer)
            return
        if not self.policy.agent.trains_behavior() and self.phase_timesteps > self.skill_selection_starts:
            self._choose_skill()
        self.policy.set_training_mode(True)
        self._set_learning_rates()
        for _ in range(gradient_steps):
            batch = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            self._metrics.add(self.learner.update(batch))
            # While the device works on the update, and until the next one.
            self.replay_buffer.prefetch(batch_size, self._vec_normalize_env)
        self._n_updates += gradient_steps
        self.phase_updates = self.learner.updates
        numerical_faults.stop_if_repeated(self)

    def _set_learning_rates(self) -> None:
        # The last rollout may overshoot the total, and a schedule of a negative rest would ascend.
        remaining = max(self._current_progress_remaining, 0.0)
        rates = {"actor_optimizer": self._actor_lr_schedule, "critic_optimizer": self._critic_lr_schedule}
        for name, optimizer in self.learner.optimizers().items():
            optimizer.set_learning_rate(rates.get(name, self.lr_schedule)(remaining))
        self.logger.record("train/learning_rate", self.lr_schedule(remaining))
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

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
