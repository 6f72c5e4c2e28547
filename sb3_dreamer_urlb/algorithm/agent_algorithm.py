"""A phased algorithm whose agent has a memory and a learner: how it acts while it learns, and when its learner updates."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Collection, Iterator, Mapping
from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np
import torch as th
from stable_baselines3.common.noise import ActionNoise

from sb3_dreamer_urlb import phases
from sb3_dreamer_urlb.algorithm import advice
from sb3_dreamer_urlb.algorithm.checks import check_scheduled_rate
from sb3_dreamer_urlb.algorithm.phased import PhasedAlgorithm
from sb3_dreamer_urlb.algorithm.policy import AgentPolicy, Memory
from sb3_dreamer_urlb.learning import graphs
from sb3_dreamer_urlb.learning.base import BaseLearner
from sb3_dreamer_urlb.learning.numerical_faults import UpdateGuard
from sb3_dreamer_urlb.snapshots.archive import Target
from sb3_dreamer_urlb.types import MetricMeans


class AgentAlgorithm(PhasedAlgorithm):
    """The part of an algorithm between its agent, its environments and its learner.

    A subclass says with :meth:`_check_arguments` what fits, with :meth:`_new_learner` what trains the agent, with
    :meth:`_learner_config` by which numbers and with :meth:`_learning_rates` how fast; it may override
    :meth:`_prepare_policy`, :meth:`_prepare_updates` and :meth:`_tell_parts`.
    """

    policy: AgentPolicy[Any]
    #: name → the arguments that a preset changes
    presets: ClassVar[Mapping[str, dict[str, Any]]] = MappingProxyType({})
    #: what its presets are made for, see :func:`~sb3_dreamer_urlb.algorithm.advice.warn_of_preset`
    presets_made_for: ClassVar[Mapping[str, Collection[str]]] = MappingProxyType({})
    #: how updates run, one of ``graphs.COMPILE``
    compile: str
    learner: BaseLearner[Any, Any]
    #: what the agents in the environments remember; None at their very beginning, which may be in the middle of episodes
    _acting_state: Memory | None = None

    # -- set-up --------------------------------------------------------------------------------------------------------

    @abstractmethod
    def _new_learner(self) -> BaseLearner[Any, Any]:
        """What trains ``policy``, in the current phase."""

    def _setup_model(self) -> None:
        super()._setup_model()
        if "policy" in vars(self):
            advice.warn_of_preset(self.preset, self.presets_made_for, self.policy.observations.has_images)

    def _build(self) -> None:
        with self._building():
            self._build_parts()

    def _build_parts(self) -> None:
        if getattr(self, "replay_buffer", None) is None:
            self.replay_buffer = self._new_replay_buffer()
        self._skipped_before = self.skipped_updates
        self.policy = self._new_policy().to(self.device)  # type: ignore[assignment]
        self.learner = self._new_learner()
        self.learner.updates = self.phase_updates
        if self.verbose >= 1:
            for line in self._about():
                print(line)
        self._acting_state = None
        self._metrics = MetricMeans()

    def _first_of_policy(self) -> dict[str, Any]:
        """The arguments in front of every policy's, as Stable-Baselines3 gives them."""
        return {
            "observation_space": self.observation_space,
            "action_space": self.action_space,
            "lr_schedule": self.lr_schedule,
        }

    def _first_of_replay(self) -> dict[str, Any]:
        """The arguments in front of every replay's, as Stable-Baselines3 gives them."""
        return {
            "buffer_size": self.buffer_size,
            "observation_space": self.observation_space,
            "action_space": self.action_space,
        }

    def _about(self) -> Iterator[str]:
        """What a user wants to know of what was built."""
        yield f"Products of updates in {self.learner.dtype}"
        yield f"Replay in the store {self.replay_buffer.store!r}"

    @abstractmethod
    def _check_arguments(self) -> None:
        """
        :raises ValueError: for a value that does not fit
        """

    @abstractmethod
    def _learner_config(self) -> Any:
        """The numbers of an update, as the arguments have them now."""

    def _prepare(self) -> None:
        self._check_arguments()
        super()._prepare()
        graphs.warn_if_in_vain(self.compile, self.device)

    def _tell_parts(self) -> None:
        """Policy and replay, as far as they hold copies of arguments that can be assigned."""

    def _put_in_force(self) -> None:
        self._check_arguments()
        self._tell_parts()
        self._setup_lr_schedule()
        self._convert_train_freq()
        self.learner.configure(self._learner_config())

    # -- files ---------------------------------------------------------------------------------------------------------

    def adams(self) -> dict[str, th.optim.Adam]:
        """Those of the learner, by their names in snapshots."""
        return {name: optimizer.adam for name, optimizer in self.learner.optimizers().items()}

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        return ["policy", *(f"learner.{name}.adam" for name in self.learner.optimizers())], []

    def _guard(self) -> UpdateGuard | None:
        learner: BaseLearner[Any, Any] | None = getattr(self, "learner", None)
        return None if learner is None else learner.guard

    def load_replay_buffer(self, path: Target, truncate_last_traj: bool = True) -> None:
        super().load_replay_buffer(path, truncate_last_traj)
        # Its next row begins an episode.
        self._acting_state = None

    # -- acting --------------------------------------------------------------------------------------------------------

    def _prepare_policy(self) -> None:
        """Tell the policy what it should know of the run before it acts."""

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """See the policy's :meth:`~sb3_dreamer_urlb.algorithm.policy.AgentPolicy.predict`; acts as the run has come to."""
        self.take_over_changes()
        self._prepare_policy()
        return self.policy.predict(observation, state, episode_start, deterministic)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """One step of the agent with its memory; what it remembers is the action *as executed*."""
        assert self._last_obs is not None and self._last_episode_starts is not None
        observation, _ = self.policy.obs_to_tensor(self._last_obs)
        state, starts = self._acting_state, self._last_episode_starts
        if state is None:
            # As in the replay, where an episode begins with whatever comes first.
            state, starts = self.policy.initial_state(n_envs), np.ones(n_envs, bool)
        self._prepare_policy()
        with th.no_grad():
            state = self.policy.observe(observation, state, th.as_tensor(starts, device=self.device))
            actions = self._random_actions(learning_starts, n_envs)
            if actions is None:
                state = self.policy.choose(state, deterministic=False)
                actions = state.action.cpu().numpy()
        actions = self._as_executed(actions, action_noise)
        state.action = th.as_tensor(actions, device=self.device)
        self._acting_state = state
        return self.policy.to_env_action(actions), actions

    # -- learning ------------------------------------------------------------------------------------------------------

    def _prepare_updates(self) -> None:
        """What is due before the updates of a rollout."""

    @abstractmethod
    def _learning_rates(self, remaining: float) -> dict[str, float]:
        """The step size of each of the learner's optimisers, by name.

        :param remaining: share of the run that is left, 1 to 0
        """

    def train(self, gradient_steps: int, batch_size: int) -> None:
        """Update on what was replayed; does nothing while there is nothing to draw.

        :param gradient_steps: number of updates
        :param batch_size: B
        :raises NumericalFaultError: if losses or gradients stay non-finite
        """
        self.take_over_changes()
        if not self.replay_buffer.can_sample():
            return
        if self.learner.updates == 0:
            advice.warn_if_pictures_are_black(self._last_obs, self.observation_space)
        self._prepare_updates()
        self.policy.set_training_mode(True)
        self._set_learning_rates()
        for _ in range(gradient_steps):
            batch = self.replay_buffer.sample(batch_size, env=self._drawn_through())
            self._metrics.add(self.learner.update(batch))
            # While the device works on the update, and until the next one.
            self.replay_buffer.prefetch(batch_size, self._drawn_through())
        self._n_updates += gradient_steps
        self.phase_updates = self.learner.updates
        self.learner.guard.stop_if_repeated(self.num_timesteps, self._rewarded_by())

    def _rewarded_by(self) -> str:
        """What the behaviour learns from, for messages: the intrinsic reward's class while it explores, else the task."""
        explores = self.phase == phases.PRETRAINING
        return f"The intrinsic reward {type(self.policy.agent.intrinsic).__name__}" if explores else "The task's reward"

    def _set_learning_rates(self) -> None:
        # The last rollout may overshoot the total, and a schedule of a negative rest would ascend.
        remaining = max(self._current_progress_remaining, 0.0)
        rates = self._learning_rates(remaining)
        for name, optimizer in self.learner.optimizers().items():
            check_scheduled_rate(f"The schedule of {name}", rates[name], remaining)
            optimizer.set_learning_rate(rates[name])
        self.logger.record("train/learning_rate", self.lr_schedule(remaining))
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
