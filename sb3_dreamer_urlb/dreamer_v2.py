"""DreamerV2 as a Stable-Baselines3 algorithm: SB3's contract, nothing of the model."""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Iterable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule, TrainFreq
from stable_baselines3.common.utils import FloatSchedule
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, VecTransposeImage

from sb3_dreamer_urlb import arguments, env_steps, numerical_faults, phases, run_folder
from sb3_dreamer_urlb.actions import make_actions
from sb3_dreamer_urlb.behavior.actor_critic import AUTO, choose_gradient
from sb3_dreamer_urlb.envs.faults import check_finite_action
from sb3_dreamer_urlb.intrinsic import IntrinsicReward, SkillReward, make_intrinsic_reward
from sb3_dreamer_urlb.learner import Learner, LearnerConfig
from sb3_dreamer_urlb.planning import make_planner
from sb3_dreamer_urlb.policies import ActingState, CnnPolicy, DreamerPolicy, MlpPolicy, MultiInputPolicy
from sb3_dreamer_urlb.presets import with_preset
from sb3_dreamer_urlb.replay import SequenceReplayBuffer
from sb3_dreamer_urlb.run_folder import RunFolder
from sb3_dreamer_urlb.snapshots import model as model_snapshot
from sb3_dreamer_urlb.snapshots import replay as replay_snapshot
from sb3_dreamer_urlb.snapshots.archive import Target
from sb3_dreamer_urlb.types import MetricMeans

SelfDreamerV2 = TypeVar("SelfDreamerV2", bound="DreamerV2")


class DreamerV2(OffPolicyAlgorithm):
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
    policy: DreamerPolicy
    policy_class: type[DreamerPolicy]
    replay_buffer: SequenceReplayBuffer
    learner: Learner

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
        preset: str = "paper",
        _init_setup_model: bool = True,
    ):
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
        self.preset = preset

        #: name of the phase; with its own counters, which ``learn`` never resets
        self.phase = phases.FINETUNING if intrinsic_reward is None else phases.PRETRAINING
        self.phase_timesteps = 0
        self.phase_updates = 0
        #: environment frames seen in the phase: agent steps × action repeat
        self.phase_frames = 0
        #: environment frames an agent step
        self.action_repeat = 1
        #: faults that environments' guards reported so far
        self.env_faults = 0
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
        self._setup_lr_schedule()
        self._actor_lr_schedule = FloatSchedule(self.actor_learning_rate)
        self._critic_lr_schedule = FloatSchedule(self.critic_learning_rate)
        path = self.replay_buffer_kwargs.get("path")
        if isinstance(path, os.PathLike):
            # As snapshots can hold it.
            self.replay_buffer_kwargs = {**self.replay_buffer_kwargs, "path": os.fspath(path)}
        arguments.check(self)
        self._convert_train_freq()
        self._read_env()

    def _read_env(self) -> None:
        """What the environment tells about itself beyond its spaces."""
        if self.env is None:
            return
        self.action_repeat = int(arguments.env_attribute(self.env, "action_repeat", 1))
        self.domain = arguments.env_attribute(self.env, "domain", None)
        if self.discount_head is None:
            self.discount_head = not arguments.env_attribute(self.env, "never_terminates", False)

    def _build(self) -> None:
        """Fresh networks, optimisers and replay for the current phase."""
        intrinsic = self._intrinsic()
        self.skill_size = 0 if intrinsic is None or intrinsic.skills is None else intrinsic.skills.dim
        if getattr(self, "replay_buffer", None) is None:
            self.replay_buffer = self._new_replay_buffer()
        self.policy = self._new_policy().to(self.device)
        self.learner = Learner(self.policy.agent, self._learner_config(intrinsic))
        self.learner.updates = self.phase_updates
        if self.verbose >= 1:
            print(f"Products of updates in {self.learner.dtype}, of the planner in {self.policy.planner_dtype}")
        self._acting_state: ActingState | None = None
        self._metrics = MetricMeans()

    def _new_policy(self) -> DreamerPolicy:
        return self.policy_class(
            self.observation_space,
            self.action_space,
            self.lr_schedule,
            gamma=self.gamma,
            discount_head=bool(self.discount_head),
            intrinsic=self._intrinsic(),
            explores=phases.PHASES[self.phase].explores,
            planner=make_planner(self.planner, self.planner_kwargs, self.gae_lambda, make_actions(self.action_space).classes),
            precision=self.precision,
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
        )

    def _new_replay_buffer(self) -> SequenceReplayBuffer:
        buffer_class: Any = self.replay_buffer_class or SequenceReplayBuffer
        return buffer_class(
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

    def _get_policy_from_name(self, policy_name: str) -> type[BasePolicy]:
        if policy_name not in self.policy_aliases:
            raise ValueError(f"Unknown policy {policy_name!r}; known are {sorted(self.policy_aliases)}.")
        return self.policy_aliases[policy_name]

    # -- phases --------------------------------------------------------------------------------------------------------

    def fine_tune(self, env: GymEnv | None = None, keep_actor: bool | None = None, keep_critic: bool = False) -> None:
        """Leave pre-training: what ``phases.TRANSFER`` keeps stays, everything else starts afresh (paper §3).

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
        self.phase = phases.FINETUNING
        self.phase_timesteps, self.phase_frames, self.phase_updates = 0, 0, 0
        del self.replay_buffer
        self._build()
        phases.transfer(pretrained, self.policy.agent, keep_actor, keep_critic)
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
        sequences = -(-max(phases.SKILL_STATES, self.batch_size * self.batch_length) // self.batch_length)
        batch = self.replay_buffer.sample(sequences, env=self._vec_normalize_env)
        model = agent.world_model
        with th.no_grad():
            posterior = model.observe(model.preprocess(batch.observation), batch.action, batch.is_first)
            agent.intrinsic.skills.fix(agent.intrinsic.choose_skill(agent.actor, posterior, batch))

    def restart_episodes(self) -> None:
        """Reset all environments in the middle of ``learn``, because they changed."""
        assert self.env is not None
        self.replay_buffer.close_streams()
        self._last_obs = self.env.reset()  # type: ignore[assignment]
        if self._vec_normalize_env is not None:
            self._last_original_obs = self._original_obs(self._vec_normalize_env)  # type: ignore[assignment]
        self._last_episode_starts = np.ones(self.env.num_envs, bool)

    def prepare_env(self, env: GymEnv) -> VecEnv:
        """Wrap an environment as SB3 does, and check that this model can go on in it.

        :param env: vectorised or not
        :raises ValueError: if it does not fit
        """
        wrapped = self._wrap_env(env, self.verbose)
        arguments.check_env(self, wrapped)
        return wrapped

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """As SB3's; also checks that episodes are long enough, and reads the new environment's action repeat.

        :param env: with the model's number of environments and its spaces
        :param force_reset: reset it before going on
        :raises ValueError: if it does not fit; the model stays as it is
        """
        super().set_env(self.prepare_env(env), force_reset)
        self._read_env()

    # -- acting --------------------------------------------------------------------------------------------------------

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """See :meth:`DreamerPolicy.predict`; plans if a planner is set and its time has come."""
        self.policy.planning = self._planner_is_on()
        return self.policy.predict(observation, state, episode_start, deterministic)

    def _planner_is_on(self) -> bool:
        due = self.phase_timesteps >= self.learning_starts + self.planner_delay
        return self.planner is not None and phases.PHASES[self.phase].plans and due and self.policy.agent.trains_behavior()

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """One step of the recurrent agent; what it remembers is the action *as executed*."""
        assert self._last_obs is not None and self._last_episode_starts is not None
        observation, _ = self.policy.obs_to_tensor(self._last_obs)
        state = self._acting_state or self.policy.initial_state(n_envs)
        self.policy.planning = self._planner_is_on()
        with th.no_grad():
            state = self.policy.observe(observation, state, th.as_tensor(self._last_episode_starts, device=self.device))
            if phases.PHASES[self.phase].random_warmup and self.phase_timesteps < learning_starts:
                uniform = np.stack([self.action_space.sample() for _ in range(n_envs)])
                scaled = self.policy.actions.from_env(uniform)
            else:
                state = self.policy.choose(state, deterministic=False)
                scaled = state.action.cpu().numpy()
        if action_noise is not None:
            scaled = np.clip(scaled + action_noise().reshape(n_envs, -1), -1, 1)
        check_finite_action(scaled, "The policy", self.num_timesteps)
        scaled = scaled.astype(np.float32)
        state.action = th.as_tensor(scaled, device=self.device)
        self._acting_state = state
        self.phase_timesteps += n_envs
        self.phase_frames += n_envs * self.action_repeat
        return self.policy.to_env_action(scaled), scaled

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """As SB3's: the replay holds what the environment gave; and the recurrent state needs to know where episodes begin."""
        normalizer = self._vec_normalize_env
        if normalizer is None:
            self._last_original_obs, original_obs = self._last_obs, new_obs  # type: ignore[assignment]
        else:
            original_obs, reward = self._original_obs(normalizer), normalizer.get_original_reward()
        self.env_faults += env_steps.count_faults(infos)
        # The VecEnv has already begun the next episode: put the true last observation back.
        next_obs = copy.deepcopy(original_obs)
        for i in np.flatnonzero(dones):
            if (last := infos[i].get("terminal_observation")) is not None:
                _put(next_obs, int(i), last if normalizer is None else normalizer.unnormalize_obs(last))
        env_steps.check_finite(next_obs, reward, self.num_timesteps)
        assert self._acting_state is not None
        skill = {"skill": self._acting_state.skill.cpu().numpy()} if self.skill_size else {}
        replay_buffer.add(self._last_original_obs, next_obs, buffer_action, reward, dones, infos, **skill)  # type: ignore[arg-type]
        self._last_obs, self._last_original_obs = new_obs, original_obs  # type: ignore[assignment]
        self._last_episode_starts = dones.astype(bool)

    def _original_obs(self, normalizer: VecNormalize) -> np.ndarray | dict[str, np.ndarray]:
        """The last observation before normalisation, with channels first as the model sees it."""
        original = normalizer.get_original_obs()
        return self.env.transpose_observations(original) if isinstance(self.env, VecTransposeImage) else original

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

        :param total_timesteps: agent steps
        :param callback: SB3 callback(s)
        :param log_interval: episodes between two log lines
        :param tb_log_name: name of the TensorBoard run
        :param reset_num_timesteps: restart ``num_timesteps``; the phase's own counters go on in any case
        :param progress_bar: show one
        """
        with self.during_learn:
            total_timesteps, callbacks = self._setup_learn(
                total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar
            )
            callbacks.on_training_start(locals(), globals())
            assert self.env is not None and isinstance(self.train_freq, TrainFreq)
            while self.num_timesteps < total_timesteps:
                rollout = self.collect_rollouts(
                    self.env,
                    callbacks,
                    self.train_freq,
                    self.replay_buffer,
                    self.action_noise,
                    self.learning_starts,
                    log_interval,
                )
                if not rollout.continue_training:
                    break
                # SB3 gates on num_timesteps, which every learn() resets.
                if self.phase_timesteps > self.learning_starts:
                    steps = self.gradient_steps if self.gradient_steps >= 0 else rollout.episode_timesteps
                    self.train(steps, self.batch_size)
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
        if self._vec_normalize_env is not None:
            self._last_original_obs = self._original_obs(self._vec_normalize_env)  # type: ignore[assignment]
        return result

    def train(self, gradient_steps: int, batch_size: int) -> None:
        """Update on replayed sequences; does nothing while no finished episode is long enough.

        :param gradient_steps: number of updates
        :param batch_size: B
        :raises NumericalFaultError: if losses or gradients stay non-finite; the last good state is saved then
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
        self.logger.record("train/skipped_updates", self.learner.guard.total())
        self.logger.record("rollout/env_faults", self.env_faults)
        self.logger.record("time/phase", self.phase, exclude="tensorboard")
        self.logger.record("time/phase_frames", self.phase_frames)
        super().dump_logs()

    # -- saving --------------------------------------------------------------------------------------------------------

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        optimizers = [f"learner.{name}.adam" for name in self.learner.optimizers()]
        return ["policy", *optimizers], []

    def save(  # type: ignore[override]
        self, path: Target, exclude: Iterable[str] | None = None, include: Iterable[str] | None = None
    ) -> None:
        """Write the model, without replay and environment, in a form that can never run code.

        :param path: path (``.zip`` is added where it has no suffix; written atomically), or binary file object
        :param exclude: part of SB3's interface; a snapshot is always whole
        :param include: likewise
        :raises ValueError: for ``exclude`` or ``include``, or if a weight is not finite; the old file stays
        :raises OSError: naming the path; the old file stays
        """
        if exclude or include:
            raise ValueError("A snapshot is always whole: save() takes neither exclude nor include.")
        model_snapshot.save(self, path)

    @classmethod
    def load(  # type: ignore[override]
        cls: type[SelfDreamerV2],
        path: Target,
        env: GymEnv | str | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> SelfDreamerV2:
        """Read what :meth:`save` wrote. No code ever runs from a file, whoever made it.

        A model with a ``seed`` goes on with the random states of the file, one without draws anew.

        :param path: of the ``.zip``, or a binary file object
        :param env: environment to go on in
        :param device: where to put the networks
        :param custom_objects: arguments that replace the stored ones, needed for those that no file can hold: functions as
            learning rates, classes that are not registered; unknown names are ignored, as SB3 does
        :param print_system_info: print those of the file and of this machine
        :param force_reset: part of SB3's interface; the environment is always reset
        :param kwargs: constructor arguments to change; a new ``seed`` also draws anew
        :raises TypeError: for a keyword that is no constructor argument
        :raises SnapshotError: naming the file and why it is refused
        """
        arguments.check_load_keywords(cls, kwargs)
        return model_snapshot.load(cls, path, env, device, custom_objects, print_system_info, kwargs)[0]

    @classmethod
    def resume(
        cls: type[SelfDreamerV2],
        folder: str | os.PathLike[str],
        env: GymEnv | str | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> SelfDreamerV2 | None:
        """Go on with a run that a :class:`~sb3_dreamer_urlb.RunCheckpointCallback` kept, replay included.

        Continue with ``learn(total - model.num_timesteps, reset_num_timesteps=False)``.

        :param folder: of the run
        :param env: environment to go on in
        :param device: see :meth:`load`
        :param custom_objects: see :meth:`load`
        :param kwargs: see :meth:`load`
        :return: the model as of the last checkpoint, random states included; None if there is none yet
        :raises SnapshotError: naming the file and why it is refused
        :raises RuntimeError: if the run is still going
        """
        arguments.check_load_keywords(cls, kwargs)
        return run_folder.resume(
            cls, folder, env, device=device, custom_objects=custom_objects, print_system_info=False, kwargs=kwargs
        )

    def set_parameters(  # type: ignore[override]
        self, load_path_or_dict: Target | dict[str, Any], exact_match: bool = True, device: th.device | str = "auto"
    ) -> None:
        """Take over weights and the optimisers' moments.

        :param load_path_or_dict: what :meth:`save` wrote, or what :meth:`get_parameters` gave
        :param exact_match: False takes what both have
        :param device: part of SB3's interface; the parameters stay where they are
        :raises SnapshotError: naming the file and why it is refused; the model stays as it is
        """
        if isinstance(load_path_or_dict, dict):
            super().set_parameters(load_path_or_dict, exact_match, device)
        else:
            model_snapshot.set_parameters(self, load_path_or_dict, exact_match)

    def save_replay_buffer(self, path: Target) -> None:  # type: ignore[override]
        """Write the replay, open episodes included, in a form that can never run code.

        :param path: path (``.pkl`` is added where it has no suffix, as SB3's callbacks name it), or binary file object
        """
        replay_snapshot.save(self.replay_buffer, path)

    def load_replay_buffer(self, path: Target, truncate_last_traj: bool = True) -> None:  # type: ignore[override]
        """Go on with a saved replay buffer.

        :param path: what :meth:`save_replay_buffer` wrote
        :param truncate_last_traj: part of SB3's interface; open episodes are always ended
        :raises SnapshotError: if the file is damaged, does not fit the model, or was filled in another phase; the model
            keeps its own then
        """
        buffer = self._new_replay_buffer()
        replay_snapshot.load(buffer, path)
        self.replay_buffer = buffer


def _put(observations: np.ndarray | dict[str, np.ndarray], i: int, observation: np.ndarray | dict[str, np.ndarray]) -> None:
    """Replace the observation of environment ``i``."""
    if isinstance(observations, dict):
        for name, values in observations.items():
            values[i] = observation[name]  # type: ignore[call-overload]
    else:
        observations[i] = observation
