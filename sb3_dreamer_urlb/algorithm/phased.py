"""What the algorithm does with its environments: acts in them, and keeps what they gave. SB3's hooks of collecting."""

from __future__ import annotations

import copy
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import torch as th
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, VecTransposeImage

from sb3_dreamer_urlb import phases
from sb3_dreamer_urlb.dreamer_v2 import arguments
from sb3_dreamer_urlb.dreamer_v2.policies import ActingState, DreamerPolicy
from sb3_dreamer_urlb.envs import env_steps
from sb3_dreamer_urlb.envs.faults import check_finite_action
from sb3_dreamer_urlb.replay import SequenceReplayBuffer

if TYPE_CHECKING:
    from sb3_dreamer_urlb.dreamer_v2 import DreamerV2


class ActingAlgorithm(OffPolicyAlgorithm):
    """The part of :class:`~sb3_dreamer_urlb.DreamerV2` between the agent and its environments."""

    policy: DreamerPolicy
    replay_buffer: SequenceReplayBuffer
    phase: str
    #: agent steps and environment frames in the phase
    phase_timesteps: int
    phase_frames: int
    #: environment frames an agent step
    action_repeat: int
    #: of the environment's task, None where it does not tell
    domain: str | None
    #: faults that environments' guards reported so far
    env_faults: int
    planner: str | None
    planner_delay: int
    discount_head: bool | None
    skill_size: int
    _acting_state: ActingState | None

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

    def forget_step(self) -> None:
        """The step whose actions were chosen last came to no end: it does not count, and who goes on needs a reset.

        Some of the environments may have made it, and nobody knows what came of it.
        """
        self.phase_timesteps -= self.n_envs
        self.phase_frames -= self.n_envs * self.action_repeat
        self._last_obs = None

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
            self._last_original_obs, original_obs = self._last_obs, new_obs
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
        self._last_obs, self._last_original_obs = new_obs, original_obs
        self._last_episode_starts = dones.astype(bool)

    def _original_obs(self, normalizer: VecNormalize) -> np.ndarray | dict[str, np.ndarray]:
        """The last observation before normalisation, with channels first as the model sees it."""
        original = normalizer.get_original_obs()
        return self.env.transpose_observations(original) if isinstance(self.env, VecTransposeImage) else original

    # -- environments --------------------------------------------------------------------------------------------------

    def restart_episodes(self) -> None:
        """Reset all environments in the middle of ``learn``, because they changed."""
        assert self.env is not None
        self.replay_buffer.close_streams()
        self._last_obs = self.env.reset()  # type: ignore[assignment]
        if self._vec_normalize_env is not None:
            self._last_original_obs = self._original_obs(self._vec_normalize_env)
        self._last_episode_starts = np.ones(self.env.num_envs, bool)

    def prepare_env(self, env: GymEnv) -> VecEnv:
        """Wrap an environment as SB3 does, and check that this model can go on in it.

        :param env: vectorised or not
        :raises ValueError: if it does not fit
        """
        wrapped = self._wrap_env(env, self.verbose)
        arguments.check_env(cast("DreamerV2", self), wrapped)
        return wrapped

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """As SB3's; also checks that episodes are long enough, and reads the new environment's action repeat.

        :param env: with the model's number of environments and its spaces
        :param force_reset: reset it before going on
        :raises ValueError: if it does not fit; the model stays as it is
        """
        super().set_env(self.prepare_env(env), force_reset)
        self._read_env()

    def _read_env(self) -> None:
        """What the environment tells about itself beyond its spaces."""
        if self.env is None:
            return
        self.action_repeat = int(arguments.env_attribute(self.env, "action_repeat", 1))
        self.domain = arguments.env_attribute(self.env, "domain", None)
        if self.discount_head is None:
            self.discount_head = not arguments.env_attribute(self.env, "never_terminates", False)


def _put(observations: np.ndarray | dict[str, np.ndarray], i: int, observation: np.ndarray | dict[str, np.ndarray]) -> None:
    """Replace the observation of environment ``i``."""
    if isinstance(observations, dict):
        for name, values in observations.items():
            values[i] = observation[name]
    else:
        observations[i] = observation
