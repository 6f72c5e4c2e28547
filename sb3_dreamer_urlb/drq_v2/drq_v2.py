"""DrQ-v2 as a Stable-Baselines3 algorithm: SB3's contract, nothing of the networks."""

from __future__ import annotations

import warnings
from typing import Any, ClassVar, TypeVar

import torch as th
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.vec_env import VecFrameStack, is_vecenv_wrapped

from sb3_dreamer_urlb import phases
from sb3_dreamer_urlb.algorithm.agent_algorithm import AgentAlgorithm
from sb3_dreamer_urlb.drq_v2 import arguments, kept_parts
from sb3_dreamer_urlb.drq_v2.learner import DrQLearner, DrQLearnerConfig
from sb3_dreamer_urlb.drq_v2.noise import NoiseStd, noise_at
from sb3_dreamer_urlb.drq_v2.policies import CnnPolicy, DrQPolicy, MlpPolicy
from sb3_dreamer_urlb.drq_v2.presets import MADE_FOR, PRESETS, with_preset
from sb3_dreamer_urlb.intrinsic import TransitionReward, make_intrinsic_reward
from sb3_dreamer_urlb.replay.n_step import NStepFrameReplayBuffer
from sb3_dreamer_urlb.signatures import answering_unknown_keywords, constructed

SelfDrQv2 = TypeVar("SelfDrQv2", bound="DrQv2")


class DrQv2(AgentAlgorithm):
    """DrQ-v2, the benchmark's agent without a world model, with unsupervised pre-training.

    DDPG from pixels with random shifts and n-step returns (Yarats et al., 2021), in the sizes and with the exploration of the
    Unsupervised RL Benchmark (URLB, Laskin et al., 2021). With an ``intrinsic_reward`` the model starts in the *pre-training*
    phase: the environment's rewards are logged but drive nothing. Without one it learns the task at once. :meth:`fine_tune`,
    or a :class:`~sb3_dreamer_urlb.PhaseSwitchCallback`, moves on to fine-tuning with the pre-trained encoder, actor and trunk
    of the critic. All defaults are the benchmark's for pixels.

    The environment gives single frames, of which the agent stacks the last few itself: they are stored once. The benchmark's
    are of 84×84 pixels: ``gymnasium.make("urlb/walker-walk-v0", image_size=84)``. Behind a ``VecFrameStack`` write
    ``frame_stack=1``.

    :meth:`fine_tune` keeps encoder, actor and the critic's trunk, in every domain; with ``keep_critic`` the critic's heads,
    too. There is no reward head to keep.

    Units: ``learning_starts``, ``train_freq``, ``noise_std`` and ``buffer_size`` count *agent steps*, as everywhere in SB3;
    ``phase_frames`` counts environment frames (agent steps × action repeat), as in the paper.

    :param policy: ``"CnnPolicy"`` for images, ``"MlpPolicy"`` for vectors
    :param env: environment, vectorised or not, or its id; Box actions
    :param learning_rate: of everything; a number or a schedule
    :param buffer_size: rows of replay to keep
    :param learning_starts: agent steps of uniformly random actions in each phase, before its first update
    :param batch_size: B, steps a batch
    :param tau: share of the critic that its target takes over in each update
    :param gamma: discount factor
    :param train_freq: update after this many steps (of the vectorised environment)
    :param gradient_steps: updates each time; -1 for as many as steps were taken
    :param n_steps: n, rewards a return has before the value
    :param frame_stack: frames that the agent sees at once; None for three images, or one vector
    :param noise_std: standard deviation of the actor's noise, when it acts and when it learns; or (at first, at last, agent
        steps in between) of each phase, as (1.0, 0.1, 500000) of DrQ-v2's authors for tasks of medium difficulty
    :param noise_clip: bound of that noise when it learns
    :param freeze_encoder: the encoder learns nothing in fine-tuning
    :param intrinsic_reward: ``"disagreement"``, another registered name, a subclass or an instance of
        :class:`~sb3_dreamer_urlb.intrinsic.TransitionReward`, or None to learn the task
    :param intrinsic_kwargs: hyperparameters of the intrinsic reward, for a name or a class
    :param adam_eps: ε of all optimisers
    :param action_noise: SB3's, added to actions while training, beside the actor's own
    :param replay_buffer_class: None for :class:`~sb3_dreamer_urlb.replay.n_step.NStepFrameReplayBuffer`, or a subclass of it
    :param replay_buffer_kwargs: further arguments of it
    :param policy_kwargs: sizes of the networks, see :class:`~sb3_dreamer_urlb.drq_v2.policies.DrQPolicy`
    :param stats_window_size: episodes that rollout statistics average over
    :param tensorboard_log: folder of TensorBoard logs
    :param verbose: 0 quiet, 1 info, 2 debug
    :param seed: of everything random
    :param device: "auto", "cpu", "cuda"
    :param precision: of matrix products and convolutions: ``"float32"``, ``"bfloat16"``, or ``"auto"``, which is float32 here;
        losses, statistics and weights are float32 in any case
    :param overlap: let environments in other processes step while an update runs; the result is the same, bit for bit. False
        lets them take turns
    :param compile: how updates run, see :class:`~sb3_dreamer_urlb.DreamerV2`
    :param preset: ``"paper"``, ``"small"`` (pixels on two CPU cores), ``"vector"`` (vectors on one) or ``"tiny"`` (tests);
        replaces defaults, never what you write
    :param _init_setup_model: build the networks now
    :raises ValueError: for arguments or spaces that do not fit, before anything is built
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"CnnPolicy": CnnPolicy, "MlpPolicy": MlpPolicy}
    policy_class: type[DrQPolicy]
    assignable = arguments.ASSIGNABLE
    of_the_networks = arguments.OF_THE_NETWORKS
    filled_in = arguments.FILLED_IN
    before_fine_tuning = arguments.BEFORE_FINE_TUNING
    presets = PRESETS
    presets_made_for = MADE_FOR
    policy: DrQPolicy
    learner: DrQLearner
    replay_buffer: NStepFrameReplayBuffer
    intrinsic_reward: str | type[TransitionReward] | TransitionReward | None

    @with_preset
    def __init__(
        self,
        policy: str | type[DrQPolicy],
        env: GymEnv | str,
        learning_rate: float | Schedule = 1e-4,
        buffer_size: int = 1_000_000,
        learning_starts: int = 2000,
        batch_size: int = 256,
        tau: float = 0.01,
        gamma: float = 0.99,
        train_freq: int | tuple[int, str] = 2,
        gradient_steps: int = 1,
        n_steps: int = 3,
        frame_stack: int | None = None,
        noise_std: NoiseStd = 0.2,
        noise_clip: float = 0.3,
        freeze_encoder: bool = False,
        intrinsic_reward: str | type[TransitionReward] | TransitionReward | None = None,
        intrinsic_kwargs: dict[str, Any] | None = None,
        adam_eps: float = 1e-8,
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[NStepFrameReplayBuffer] | None = None,
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
            # By name, Stable-Baselines3 would ask for its policy of Dicts.
            self.policy_aliases.get(policy, policy) if isinstance(policy, str) else policy,
            env,
            learning_rate,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            batch_size=batch_size,
            tau=tau,
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
        self.n_steps = n_steps
        self.frame_stack = frame_stack
        self.noise_std = noise_std
        self.noise_clip = noise_clip
        self.freeze_encoder = freeze_encoder
        self.intrinsic_kwargs = intrinsic_kwargs
        self.adam_eps = adam_eps
        self.precision = precision
        self.compile = compile

        if _init_setup_model:
            self._setup_model()

    # -- set-up --------------------------------------------------------------------------------------------------------

    def _check_arguments(self) -> None:
        arguments.check(self)

    def _read_env(self) -> None:
        super()._read_env()
        stacked = self.env is not None and is_vecenv_wrapped(self.env, VecFrameStack)
        frames = self._frames()
        if stacked and frames > 1:
            warnings.warn(
                f"The environment stacks frames (VecFrameStack), and DrQv2 stacks {frames} of these stacks, most frames "
                "several times: leave the wrapper out, or write frame_stack=1."
            )

    def _frames(self) -> int:
        """Frames that the agent sees at once."""
        return self.policy_class.usual_frame_stack if self.frame_stack is None else self.frame_stack

    def _tell_parts(self) -> None:
        self.replay_buffer.gamma = self.gamma

    def _intrinsic(self) -> TransitionReward | None:
        """What the current phase explores with."""
        if not phases.PHASES[self.phase].explores:
            return None
        kind: Any = TransitionReward
        method: TransitionReward | None = make_intrinsic_reward(self.intrinsic_reward, self.intrinsic_kwargs, kind)
        return method

    def _new_policy(self) -> DrQPolicy:
        policy: DrQPolicy = constructed(
            self.policy_class,
            self._first_of_policy(),
            frame_stack=self.frame_stack,
            noise_std=self._noise(),
            intrinsic=self._intrinsic(),
            **self.policy_kwargs,
        )
        return policy

    def _new_learner(self) -> DrQLearner:
        untrained = self.pretrained_frames == 0 and not phases.PHASES[self.phase].explores
        if self.freeze_encoder and untrained and any(True for _ in self.policy.agent.encoder.parameters()):
            warnings.warn(
                "freeze_encoder=True without a pre-training: the encoder stays as it was drawn at random, unless weights are "
                "loaded into it."
            )
        return DrQLearner(self.policy.agent, self._learner_config())

    def _learner_config(self) -> DrQLearnerConfig:
        return DrQLearnerConfig(
            learning_rate=self.lr_schedule(1),
            adam_eps=self.adam_eps,
            tau=self.tau,
            noise_clip=self.noise_clip,
            freeze_encoder=self.freeze_encoder and not phases.PHASES[self.phase].explores,
            precision=self.precision,
            compile=self.compile,
        )

    def _new_replay_buffer(self) -> NStepFrameReplayBuffer:
        buffer: NStepFrameReplayBuffer = constructed(
            self.replay_buffer_class or NStepFrameReplayBuffer,
            self._first_of_replay(),
            device=self.device,
            n_envs=self.n_envs,
            frame_stack=self._frames(),
            n_steps=self.n_steps,
            gamma=self.gamma,
            **{"seed": self.seed, "phase": self.phase, **self.replay_buffer_kwargs},
        )
        return buffer

    # -- phases --------------------------------------------------------------------------------------------------------

    def _transfer(self, pretrained: BasePolicy, keep_actor: bool, keep_critic: bool, keep_reward: bool) -> None:
        assert isinstance(pretrained, DrQPolicy)
        kept_parts.transfer(pretrained.agent, self.policy.agent, keep_actor, keep_critic)

    def keeps_actor(self) -> bool:
        """Whether fine-tuning keeps the actor where nobody says: always, as the benchmark does for this agent."""
        return True

    def _warms_up_randomly(self) -> bool:
        # In both phases, as in the benchmark's code.
        return True

    # -- learning ------------------------------------------------------------------------------------------------------

    def _noise(self) -> float:
        return noise_at(self.noise_std, self.phase_timesteps)

    def _prepare_policy(self) -> None:
        self.policy.noise_std = self._noise()

    def _prepare_updates(self) -> None:
        self.learner.set_noise(self._noise())

    def _learning_rates(self, remaining: float) -> dict[str, float]:
        return dict.fromkeys(self.learner.optimizers(), self.lr_schedule(remaining))

    @answering_unknown_keywords
    def learn(
        self: SelfDrQv2,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "DrQv2",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfDrQv2:
        return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
