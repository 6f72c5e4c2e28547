"""DreamerV2 as a Stable-Baselines3 algorithm: SB3's contract, nothing of the model."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any, ClassVar, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import FloatSchedule
from stable_baselines3.common.vec_env import VecEnv

from sb3_dreamer_urlb import native, phases
from sb3_dreamer_urlb.agent import Agent
from sb3_dreamer_urlb.algorithm.agent_algorithm import AgentAlgorithm
from sb3_dreamer_urlb.behavior.actor_critic import AUTO, choose_gradient
from sb3_dreamer_urlb.dreamer_v2 import arguments, kept_parts
from sb3_dreamer_urlb.dreamer_v2.policies import ActingState, CnnPolicy, DreamerPolicy, MlpPolicy, MultiInputPolicy
from sb3_dreamer_urlb.dreamer_v2.presets import MADE_FOR, PRESETS, get_preset, with_preset
from sb3_dreamer_urlb.envs.facts import env_fact
from sb3_dreamer_urlb.intrinsic import IntrinsicReward, SkillReward, make_intrinsic_reward
from sb3_dreamer_urlb.learning.learner import Learner, LearnerConfig
from sb3_dreamer_urlb.nn.nets import MLP
from sb3_dreamer_urlb.planning import Planner, PlannerConfig, make_planner
from sb3_dreamer_urlb.replay import SequenceReplayBuffer
from sb3_dreamer_urlb.signatures import answering_unknown_keywords, constructed
from sb3_dreamer_urlb.spaces.actions import make_actions

SelfDreamerV2 = TypeVar("SelfDreamerV2", bound="DreamerV2")


class DreamerV2(AgentAlgorithm):
    """DreamerV2 with unsupervised pre-training, task-aware fine-tuning and Dyna-MPC.

    "Mastering the Unsupervised Reinforcement Learning Benchmark from Pixels" (ICML 2023). With an ``intrinsic_reward``
    the model starts in the *pre-training* phase: the environment's rewards are logged, the actor seeks others. Without one it
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
    :param planner: ``"dyna_mpc"``, ``"mppi"``, ``"mppi_zero_shot"``, another registered name, a subclass or an instance of
        :class:`~sb3_dreamer_urlb.planning.Planner`, or None; acts in fine-tuning, also in ``predict``
    :param planner_kwargs: fields of :class:`~sb3_dreamer_urlb.PlannerConfig`, for a name or a class. Without a planner they
        have no effect; they are kept, and in force once there is one: ``load(path, planner="dyna_mpc")`` or
        ``model.planner = "dyna_mpc"``
    :param planner_delay: agent steps after ``learning_starts`` until the planner takes over from the actor
    :param ent_coef: weight of the actor's entropy; None: the intrinsic reward's own while exploring (DIAYN 0.1), otherwise the
        preset's, otherwise 0 while exploring and 1e-4 on a task
    :param free_nats: the KL that costs nothing
    :param kl_balance: share of the KL's gradient that trains the prior
    :param kl_scale: weight of the KL in the model's loss
    :param actor_gradient: ``"dynamics"``: through the model, straight through where actions are one-hot; ``"reinforce"``: by
        the score function, for Discrete and MultiDiscrete actions; ``"auto"``: REINFORCE for these, dynamics for Box (as
        DreamerV2)
    :param reward_trains_model: let the reward head's gradient reach the world model in fine-tuning; False as in the authors'
        fine-tuning of DIAYN and APS (docs/algorithm.md)
    :param learn_task_reward: for ICM and RND, whose reward head learns their own reward: let a second head learn the
        environment's beside it while pre-training, for ``fine_tune(keep_reward=True)``. The one head of every other method
        learns it in any case. Names of tasks, ``["stand", "walk"]``: learn the rewards of each in a head of its own, with any
        method, in an environment made with ``domain_rewards=True``; the fine-tuning's task then chooses one
    :param freeze_decoder: let the decoder keep its pre-trained weights in fine-tuning (paper, appendix "Latent Dynamics
        Discrepancy")
    :param warmup_actions: of the pre-training before its first update: ``"uniform"`` in the action space; ``"saturated"``, the
        authors' own: uniform in ±A for A action dimensions, replayed as drawn and clipped for the environment (Box only)
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
    :param preset: ``"paper"``, ``"small"`` (pixels on two CPU cores), ``"vector"`` (vectors on one), ``"state"``
        and ``"state-small"`` (dm_control's states, the latter on one core), or ``"tiny"`` (tests);
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
    assignable = arguments.ASSIGNABLE
    of_the_networks = arguments.OF_THE_NETWORKS
    filled_in = arguments.FILLED_IN
    before_fine_tuning = arguments.BEFORE_FINE_TUNING
    presets = PRESETS
    presets_made_for = MADE_FOR
    policy: DreamerPolicy
    learner: Learner
    intrinsic_reward: str | type[IntrinsicReward] | IntrinsicReward | None
    _acting_state: ActingState | None = None

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
        planner: str | type[Planner] | Planner | None = None,
        planner_kwargs: dict[str, Any] | None = None,
        planner_delay: int = 500,
        ent_coef: float | None = None,
        free_nats: float = 1.0,
        kl_balance: float = 0.8,
        kl_scale: float = 1.0,
        actor_gradient: str = AUTO,
        reward_trains_model: bool = True,
        learn_task_reward: bool | Sequence[str] = False,
        freeze_decoder: bool = False,
        warmup_actions: str = arguments.UNIFORM,
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
        super().__init__(
            policy,
            env,
            learning_rate,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            batch_size=batch_size,
            gamma=gamma,
            train_freq=train_freq,
            gradient_steps=gradient_steps,
            intrinsic_reward=intrinsic_reward,
            action_noise=action_noise,
            replay_buffer_class=replay_buffer_class,
            replay_buffer_kwargs=replay_buffer_kwargs,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            seed=seed,
            device=device,
            overlap=overlap,
            preset=preset,
        )
        self.actor_learning_rate = actor_learning_rate
        self.critic_learning_rate = critic_learning_rate
        self.batch_length = batch_length
        self.imagination_horizon = imagination_horizon
        self.gae_lambda = gae_lambda
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
        self.reward_trains_model = reward_trains_model
        self.learn_task_reward = learn_task_reward
        self.freeze_decoder = freeze_decoder
        self.warmup_actions = warmup_actions
        self.target_update_interval = target_update_interval
        self.adam_eps = adam_eps
        self.max_grad_norm = max_grad_norm
        self.weight_decay = weight_decay
        self.discount_head = discount_head
        self.precision = precision
        self.compile = compile

        if _init_setup_model:
            self._setup_model()

    # -- set-up --------------------------------------------------------------------------------------------------------

    def _check_arguments(self) -> None:
        arguments.check(self)

    def _setup_lr_schedule(self) -> None:
        super()._setup_lr_schedule()
        self._actor_lr_schedule = FloatSchedule(self.actor_learning_rate)
        self._critic_lr_schedule = FloatSchedule(self.critic_learning_rate)

    def _tell_parts(self) -> None:
        self.policy.set_numbers(self.gamma, self._new_planner())

    def _read_env(self) -> None:
        super()._read_env()
        if self.env is not None and self.discount_head is None:
            self.discount_head = not env_fact(self.env, "never_terminates", False)

    def _learns_of_ends(self) -> bool:
        return bool(self.discount_head)

    def _learns_the_tasks_reward(self) -> bool:
        # Rewards of named tasks come beside the environment's own, which may be hidden.
        return super()._learns_the_tasks_reward() or self.learn_task_reward is True

    def _check_env(self, env: VecEnv) -> None:
        super()._check_env(env)
        arguments.check_episodes_fit(self.batch_length, self.replay_buffer_kwargs, env)

    def _build(self) -> None:
        intrinsic = self._intrinsic()
        self.skill_size = 0 if intrinsic is None or intrinsic.skills is None else intrinsic.skills.dim
        super()._build()

    def _about(self) -> Iterator[str]:
        yield f"Products of updates in {self.learner.dtype}, of the planner in {self.policy.planner_dtype}"
        yield f"Kernels: {native.describe(self.compile, self.device)}"
        yield f"Replay in the store {self.replay_buffer.store!r}"

    def _new_learner(self) -> Learner:
        return Learner(self.policy.agent, self._learner_config())

    def _new_policy(self) -> DreamerPolicy:
        policy: DreamerPolicy = constructed(
            self.policy_class,
            self._first_of_policy(),
            gamma=self.gamma,
            discount_head=bool(self.discount_head),
            intrinsic=self._intrinsic(),
            explores=phases.PHASES[self.phase].explores,
            task_reward=self.learn_task_reward,
            planner=self._new_planner(),
            precision=self.precision,
            compile=self.compile,
            **self.policy_kwargs,
        )
        return policy

    @classmethod
    def names_within(cls) -> dict[str, set[str]]:
        """As ever, with those of a planner."""
        return {**super().names_within(), "planner_kwargs": {each.name for each in dataclasses.fields(PlannerConfig)}}

    def _new_planner(self) -> Planner | None:
        return make_planner(self.planner, self.planner_kwargs, self.gae_lambda, make_actions(self.action_space).classes)

    def _intrinsic(self) -> IntrinsicReward | None:
        """What the current phase explores with; fine-tuning keeps only what has skills."""
        intrinsic = make_intrinsic_reward(self.intrinsic_reward, self.intrinsic_kwargs)
        if intrinsic is not None and intrinsic.skills is None and not phases.PHASES[self.phase].explores:
            return None
        return intrinsic

    def _learner_config(self) -> LearnerConfig:
        explores = phases.PHASES[self.phase].explores
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
            ent_coef=phases.phase_ent_coef(
                self.phase, self.policy.intrinsic, self.ent_coef, get_preset(self.preset).get("ent_coef")
            ),
            reward_trains_model=self.reward_trains_model and not explores,
            trains_behavior=explores or self.policy.planner is None or self.policy.planner.config.use_value,
            precision=self.precision,
            compile=self.compile,
            trains_decoder=explores or not self.freeze_decoder,
        )

    def _new_replay_buffer(self) -> SequenceReplayBuffer:
        buffer: SequenceReplayBuffer = constructed(
            self.replay_buffer_class or SequenceReplayBuffer,
            self._first_of_replay(),
            device=self.device,
            n_envs=self.n_envs,
            **{
                "batch_length": self.batch_length,
                "seed": self.seed,
                "phase": self.phase,
                "skill_size": self.skill_size,
                **({"tasks": tuple(tasks)} if (tasks := self.tasks_learnt()) else {}),
                **self.replay_buffer_kwargs,
            },
        )
        return buffer

    def tasks_learnt(self) -> Sequence[str]:
        """Tasks whose rewards are learnt beside the exploration, in the current phase; empty without any."""
        named = not isinstance(self.learn_task_reward, bool) and phases.PHASES[self.phase].explores
        return self.learn_task_reward if named else ()  # type: ignore[return-value]

    # -- acting --------------------------------------------------------------------------------------------------------

    def _prepare_policy(self) -> None:
        self.policy.planning = self._planner_is_on()

    def _planner_is_on(self) -> bool:
        due = self.phase_timesteps >= self.learning_starts + self.planner_delay
        return self.planner is not None and phases.PHASES[self.phase].plans and due and self.policy.agent.trains_behavior()

    def _random_actions(self, learning_starts: int, n_envs: int) -> np.ndarray | None:
        actions = super()._random_actions(learning_starts, n_envs)
        if actions is not None and self.warmup_actions == arguments.SATURATED:
            actions = actions * np.float32(actions.shape[1])
        return actions

    def _replayed_beside(self) -> dict[str, np.ndarray]:
        assert self._acting_state is not None
        return {"skill": self._acting_state.skill.cpu().numpy()} if self.skill_size else {}

    # -- phases --------------------------------------------------------------------------------------------------------

    def _check_reward_is_known(self, env: VecEnv | None) -> None:
        agent = self.policy.agent
        if _known_reward(agent, env) is not None:
            return
        if agent.task_rewards is not None:
            learnt, task = ", ".join(agent.task_rewards), None if env is None else env_fact(env, "task", None)
            raise ValueError(
                f"keep_reward=True: this pre-training learnt the rewards of {learnt}; the environment's task is {task!r}."
            )
        raise ValueError(
            f"keep_reward=True: the reward head of this pre-training learnt the reward of {self.intrinsic_reward!r}, "
            "not the task's. Pre-train with learn_task_reward=True, which adds a head for it."
        )

    def _transfer(self, pretrained: BasePolicy, keep_actor: bool, keep_critic: bool, keep_reward: bool) -> None:
        assert isinstance(pretrained, DreamerPolicy)
        known = _known_reward(pretrained.agent, self.env) if keep_reward else None
        kept_parts.transfer(pretrained.agent, self.policy.agent, keep_actor, keep_critic, known)

    def fix_skill(self, skill: int | np.ndarray | None) -> None:
        """Follow one skill from now on, in training as in ``predict`` (DIAYN, APS).

        :param skill: float (W,), or the number of a one-hot skill; None draws random ones again, and lets fine-tuning choose
        :raises ValueError: if the method has no skills, or this is none of them
        """
        skills = self.policy.agent.skills
        if skills is None:
            raise ValueError(f"intrinsic_reward={self.intrinsic_reward!r} has no skills.")
        if isinstance(skill, bool | np.bool_):
            raise ValueError(f"skill must be numbers, the number of a skill, or None, got {skill!r}.")
        skills.fix(skills.numbered(int(skill)) if isinstance(skill, int | np.integer) else skill)

    def _choose_skill(self) -> None:
        """Choose the skill that serves the task best (docs/algorithm.md, "Skills")."""
        agent = self.policy.agent
        if not isinstance(agent.intrinsic, SkillReward) or agent.explores:
            return
        sequences = -(-max(kept_parts.SKILL_STATES, self.batch_size * self.batch_length) // self.batch_length)
        batch = self.replay_buffer.sample(sequences, env=self._drawn_through())
        model = agent.world_model
        with th.no_grad():
            posterior = model.observe(model.preprocess(batch.observation), batch.action, batch.is_first)
            agent.intrinsic.skills.fix(agent.intrinsic.choose_skill(agent.actor, posterior, batch))

    # -- learning ------------------------------------------------------------------------------------------------------

    @answering_unknown_keywords
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
        if self.env is not None:
            arguments.check_tasks_are_told(self.tasks_learnt(), self.env)
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)

    def train(self, gradient_steps: int, batch_size: int) -> None:
        if not self.replay_buffer.can_sample():
            arguments.check_episode_length(self.replay_buffer)
        super().train(gradient_steps, batch_size)

    def _prepare_updates(self) -> None:
        if not self.policy.agent.trains_behavior() and self.phase_timesteps > self.skill_selection_starts:
            self._choose_skill()

    def _learning_rates(self, remaining: float) -> dict[str, float]:
        rates = {"actor_optimizer": self._actor_lr_schedule, "critic_optimizer": self._critic_lr_schedule}
        return {name: rates.get(name, self.lr_schedule)(remaining) for name in self.learner.optimizers()}


def _known_reward(agent: Agent, env: VecEnv | None) -> MLP | None:
    """The head that knows the reward of an environment's task."""
    several = agent.task_rewards is not None and env is not None
    return agent.known_reward(env_fact(env, "task", None) if several else None)  # type: ignore[arg-type]
