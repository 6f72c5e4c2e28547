"""How an algorithm collects: it acts, and keeps what its environments gave before anything else can happen."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise, VectorizedActionNoise
from stable_baselines3.common.type_aliases import RolloutReturn, TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.utils import should_collect_more_steps
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from sb3_dreamer_urlb import phases
from sb3_dreamer_urlb.algorithm import advice, left_environments
from sb3_dreamer_urlb.algorithm.environment_checks import needed_env
from sb3_dreamer_urlb.algorithm.saving import SavingAlgorithm
from sb3_dreamer_urlb.algorithm.training_loop import LearningVecEnv
from sb3_dreamer_urlb.envs import env_steps
from sb3_dreamer_urlb.envs.broken_rules import asking_to
from sb3_dreamer_urlb.envs.faults import check_finite_action
from sb3_dreamer_urlb.envs.info_keys import TERMINAL
from sb3_dreamer_urlb.envs.normalized import RewardsOnly, hides_originals, original_end, original_observations
from sb3_dreamer_urlb.envs.touches import last_touches
from sb3_dreamer_urlb.spaces.actions import make_actions
from sb3_dreamer_urlb.spaces.observation_checks import check_classes


class CollectingAlgorithm(SavingAlgorithm):
    """The part of :class:`PhasedAlgorithm` between an agent and its environments."""

    #: agent steps and environment frames in the phase
    phase_timesteps: int
    phase_frames: int
    #: environment frames an agent step
    action_repeat: int
    #: faults that environments' guards reported so far
    env_faults: int
    #: ``<domain>-<task>`` of the present environment, None where it does not tell
    _task: str | None = None
    #: whether that gives rewards of zero, whatever its task would pay; False once that was told
    _hides_rewards = False
    #: see ``last_touches``; as of when the model itself last reset or stepped its environments
    _touches: tuple[int, ...] = ()
    #: see :meth:`_drawn_through`
    _rewards_only: RewardsOnly | None = None

    def _warms_up_randomly(self) -> bool:
        """Whether the steps before this phase's first update act uniformly at random, not with the actor."""
        return phases.PHASES[self.phase].random_warmup

    def _random_actions(self, learning_starts: int, n_envs: int) -> np.ndarray | None:
        """Uniformly random actions while this phase's warm-up lasts, float32 (n, A) as the agent chooses them; then None.

        :param learning_starts: agent steps of the warm-up
        :param n_envs: n
        """
        if not self._warms_up_randomly() or self.phase_timesteps >= learning_starts:
            return None
        return make_actions(self.action_space).from_env(np.stack([self.action_space.sample() for _ in range(n_envs)]))

    def _as_executed(self, actions: np.ndarray, action_noise: ActionNoise | None) -> np.ndarray:
        """The actions that environments will get, float32 (n, A) in [-1, 1], or one-hot; counts their step.

        :param actions: as chosen
        :param action_noise: added to them
        :raises ValueError: if one is not finite, or the noise is for other actions
        """
        n = len(actions)
        if action_noise is not None:
            # One for all environments, or one for each.
            noise = np.asarray(action_noise())
            rows = n if isinstance(action_noise, VectorizedActionNoise) else 1
            if noise.size not in (rows, rows * actions[0].size):
                raise ValueError(
                    f"action_noise gives {noise.size} numbers, for {n} environment(s) with {actions[0].size} actions each."
                )
            if not np.isfinite(noise).all():
                raise ValueError(f"action_noise gives {noise}; expected finite numbers.")
            actions = np.clip(actions + noise.reshape(rows, -1), -1, 1)
        check_finite_action(actions, "The policy", self.num_timesteps)
        self.phase_timesteps += n
        self.phase_frames += n * self.action_repeat
        return actions.astype(np.float32)

    def collect_rollouts(
        self,
        env: VecEnv,
        callback: BaseCallback,
        train_freq: TrainFreq,
        replay_buffer: ReplayBuffer,
        action_noise: ActionNoise | None = None,
        learning_starts: int = 0,
        log_interval: int | None = None,
    ) -> RolloutReturn:
        """As SB3's, but a step is kept before anybody hears of it, and only where the environment stands as it was left.

        So whatever callbacks do (stop, raise, evaluate in these very environments), rows of an episode followed each other.
        The rollout also ends where a callback brought another environment, another wrapper of it, or another replay.

        :param env: the model's
        :param callback: told as SB3 tells it, with the same names in ``locals``
        :param train_freq: length of the rollout
        :param replay_buffer: the model's
        :param action_noise: added to actions
        :param learning_starts: agent steps of the phase until the policy acts
        :param log_interval: episodes between two log lines
        :return: steps and episodes of the rollout
        """
        needed_env(self, "collect_rollouts")
        assert env.num_envs == 1 or train_freq.unit == TrainFrequencyUnit.STEP, (
            "You must use only one env when doing episodic training."
        )
        self.policy.set_training_mode(False)
        self._note_task()
        going_on_in = env.venv if isinstance(env, LearningVecEnv) else env
        num_collected_steps, num_collected_episodes = 0, 0
        continue_training = True
        callback.on_rollout_start()
        while should_collect_more_steps(train_freq, num_collected_steps, num_collected_episodes):
            if self.env is not going_on_in or self.replay_buffer is not replay_buffer:
                break
            if self._last_obs is None or self._was_touched():
                self.restart_episodes()
            with self._whole_step():
                actions, buffer_actions = self._sample_action(learning_starts, action_noise, env.num_envs)
                new_obs, rewards, dones, infos = env.step(actions)
                rewards, dones = np.asarray(rewards), np.asarray(dones, bool)
                with asking_to("step"):
                    env_steps.check_form(new_obs, rewards, dones, env.num_envs)
                self._touches = last_touches(env)
                self.num_timesteps += env.num_envs
                self._store_transition(replay_buffer, buffer_actions, new_obs, rewards, dones, infos)  # type: ignore[arg-type]
            self._count_episodes(infos, dones, action_noise)
            num_collected_steps += 1
            callback.update_locals(locals())
            if not callback.on_step():
                continue_training = False
                break
            self._update_current_progress_remaining(self.num_timesteps, self._total_timesteps)
            self._on_step()
            ended = int(dones.sum())
            num_collected_episodes += ended
            for episode in range(self._episode_num - ended + 1, self._episode_num + 1):
                # As SB3: a line for each, although several may end with one step.
                if log_interval is not None and episode % log_interval == 0:
                    self.dump_logs()
        if continue_training:
            callback.on_rollout_end()
        return RolloutReturn(num_collected_steps * env.num_envs, num_collected_episodes, continue_training)

    def _count_episodes(self, infos: list[dict[str, Any]], dones: np.ndarray, action_noise: ActionNoise | None) -> None:
        """The episodes of environments that are done are over."""
        self._update_info_buffer(infos, dones)
        for i in np.flatnonzero(dones).tolist():
            self._episode_num += 1
            if isinstance(action_noise, VectorizedActionNoise):
                action_noise.reset(indices=[i])
            elif action_noise is not None:
                action_noise.reset()

    @contextmanager
    def _whole_step(self) -> Iterator[None]:
        """A step that does not come to its end does not count, and who goes on needs a reset.

        Some of the environments may have made it, and nobody knows what came of it.
        """
        before = self.num_timesteps, self.phase_timesteps, self.phase_frames
        try:
            yield
        except BaseException:
            self.num_timesteps, self.phase_timesteps, self.phase_frames = before
            self._last_obs = None
            raise

    def _was_touched(self) -> bool:
        """Whether somebody else reset or stepped the environments since the model did, or they are others."""
        assert self.env is not None
        return last_touches(self.env) != self._touches

    def _learns_the_tasks_reward(self) -> bool:
        """Whether what the environment pays is learnt in this phase, to be sought or for later."""
        return not phases.PHASES[self.phase].explores

    def _note_task(self) -> None:
        """Remember whose rewards the agent learns from; nobody means to mix those of two tasks unawares.

        :raises ValueError: where a run goes on in another task
        """
        if self._hides_rewards and self._learns_the_tasks_reward():
            self._hides_rewards = False  # told once
            advice.warn_of_hidden_rewards(self.phase)
        if phases.PHASES[self.phase].explores or self._task is None:
            return
        if self.learnt_task not in (None, self._task):
            said = f"has learnt {self.learnt_task} so far, and its environment is now of {self._task}"
            if self.run_folder is not None and self.run_folder.resumed:
                raise ValueError(f"The run in {self.run_folder.path} {said}: a run keeps its task. load() begins another one.")
            warnings.warn(f"The model {said}: its critic and its replay know the other's rewards.")
        self.learnt_task = self._task

    def _learns_of_ends(self) -> bool:
        """Whether the agent learns that a terminated episode gives no more rewards."""
        return True

    def _replayed_beside(self) -> dict[str, np.ndarray]:
        """Further columns of the replay's rows, of the step that was just made, by name: (n, …)."""
        return {}

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """As SB3's: the replay holds what the environment gave; and a recurrent agent needs to know where episodes begin."""
        normalizer = self._vec_normalize_env
        if normalizer is None:
            self._last_original_obs, original_obs = self._last_obs, new_obs
        else:
            original_obs, reward = self._original_obs(new_obs), normalizer.get_original_reward()
        self.env_faults += env_steps.count_faults(infos)
        # The VecEnv has already begun the next episode: put the true last observation back.
        next_obs = copy.deepcopy(original_obs)
        for i in np.flatnonzero(dones):
            _put(next_obs, int(i), self._last_of_episode(int(i), infos[i]))
        env_steps.check_finite(next_obs, reward, f"step {self.num_timesteps}")
        self._check_seen("step", f"step {self.num_timesteps}", next_obs, new_obs)
        if not self._learns_of_ends():
            advice.warn_if_ends_go_unheeded(dones, infos)
        beside = self._replayed_beside()
        replay_buffer.add(self._last_original_obs, next_obs, buffer_action, reward, dones, infos, **beside)  # type: ignore[arg-type]
        # Environments may write the next observation into the same arrays.
        self._last_obs = copy.deepcopy(new_obs)
        self._last_original_obs = self._last_obs if original_obs is new_obs else copy.deepcopy(original_obs)
        self._last_episode_starts = dones.astype(bool)
        self._leave_standing()

    def _last_of_episode(self, i: int, info: dict[str, Any]) -> Any:
        """The observation with which environment ``i`` ended its episode, as the replay keeps it.

        :param i: number of the environment
        :param info: of the last step
        """
        assert self.env is not None
        normalizer = None if self._keeps_what_was_seen() else self._vec_normalize_env
        last = info.get(TERMINAL) if normalizer is None else original_end(self.env, normalizer, i)
        if last is not None:
            return last
        if not env_steps.is_fault(info):
            warnings.warn(
                "The vectorised environment ends an episode without info['terminal_observation']: nobody knows its last "
                "observation, the one before is taken for it."
            )
        before: Any = self._last_original_obs
        return {name: part[i] for name, part in before.items()} if isinstance(before, dict) else before[i]

    # -- episodes ------------------------------------------------------------------------------------------------------

    def restart_episodes(self) -> None:
        """Reset all environments in the middle of ``learn``, because they changed.

        :raises MissingEnvironmentError: if there are none
        """
        env = needed_env(self, "restart_episodes")
        self.replay_buffer.close_streams()
        with asking_to("reset"):
            self._last_obs = env.reset()  # type: ignore[assignment]
        self._last_episode_starts = np.ones(env.num_envs, bool)
        self._begin_episodes()

    def _begin_episodes(self) -> None:
        """The environments were just reset, or stand as they were left."""
        assert self.env is not None
        self._touches = last_touches(self.env)
        # Environments may write the next observation into the same arrays.
        self._last_obs = copy.deepcopy(self._last_obs)
        self._check_seen("reset", "reset", self._last_obs)
        self._leave_standing()
        if self._vec_normalize_env is not None:
            self._last_original_obs = self._original_obs(self._last_obs)

    def _check_seen(self, asked: str, when: str, *observations: Any) -> None:
        """Before anything out of its space, or NaN, is acted on or kept; ``asked`` is what the environments did."""
        assert self.env is not None
        for seen in observations:
            env_steps.check_finite(seen, np.zeros(self.env.num_envs), when)
        with asking_to(asked):
            for seen in observations:
                check_classes("The environments' observation", seen, self.observation_space)

    def _leave_standing(self) -> None:
        assert self.env is not None and self._last_episode_starts is not None
        left_environments.leave(self.env, self._touches, self._last_obs, self._last_episode_starts)

    def go_on_where_left(self) -> None:
        """Begin without a reset, if a model left the environments where they stand now."""
        if self.env is not None and (left := left_environments.found(self.env)) is not None:
            self._touches, self._last_obs, self._last_episode_starts = left.touches, left.observation, left.starts

    def _keeps_what_was_seen(self) -> bool:
        """Whether the replay holds normalised observations, because a wrapper outside of VecNormalize changed them further."""
        assert self.env is not None
        return self._vec_normalize_env is not None and hides_originals(self.env, self._vec_normalize_env)

    def _drawn_through(self) -> VecNormalize | None:
        """What normalises the rows that the replay draws."""
        if not self._keeps_what_was_seen():
            return self._vec_normalize_env
        if getattr(self._rewards_only, "normalizer", None) is not self._vec_normalize_env:
            self._rewards_only = RewardsOnly(self._vec_normalize_env)  # type: ignore[arg-type]
        return self._rewards_only  # type: ignore[return-value]

    def _original_obs(self, seen: Any) -> Any:
        """The last observation before normalisation, with channels first as the model sees it.

        :param seen: after it
        """
        if self._vec_normalize_env is None or self._keeps_what_was_seen():
            return seen
        assert self.env is not None
        return original_observations(self.env, self._vec_normalize_env)


def _put(observations: np.ndarray | dict[str, np.ndarray], i: int, observation: np.ndarray | dict[str, np.ndarray]) -> None:
    """Replace the observation of environment ``i``."""
    if isinstance(observations, dict):
        for name, values in observations.items():
            values[i] = observation[name]
    else:
        observations[i] = observation
