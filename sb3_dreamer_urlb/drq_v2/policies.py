"""Frames → stack of frames → encoding → action: what ``predict()`` runs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import Schedule

from sb3_dreamer_urlb.algorithm.policy import AgentPolicy
from sb3_dreamer_urlb.drq_v2.agent import DrQAgent
from sb3_dreamer_urlb.intrinsic import TransitionReward
from sb3_dreamer_urlb.number_checks import is_integer
from sb3_dreamer_urlb.spaces.actions import Actions, make_actions
from sb3_dreamer_urlb.spaces.errors import UnsupportedSpaceError
from sb3_dreamer_urlb.spaces.observations import Observations, vectors
from sb3_dreamer_urlb.types import Observation


@dataclasses.dataclass
class FrameMemory:
    """What an acting agent remembers from one step to the next, for n environments.

    :param frames: the last s frames, as the environment gave them, (n, s, …), the newest last
    :param action: the last action, float (n, A) in [-1, 1]
    """

    frames: th.Tensor
    action: th.Tensor

    def to_numpy(self) -> tuple[np.ndarray, ...]:
        """The form that SB3 hands through ``predict(state=…)``: arrays with leading n."""
        return self.frames.cpu().numpy(), self.action.cpu().numpy()


class DrQPolicy(AgentPolicy[FrameMemory]):
    """DrQ-v2's networks behind SB3's policy interface. This class is for images; the one below it for vectors.

    :param observation_space: one frame: an image, channels first: uint8, or floats without ``normalize_images``
    :param action_space: Box with finite bounds
    :param lr_schedule: unused here (the learner owns the optimisers), part of SB3's interface
    :param cnn_depth: channels of the encoder's convolutions
    :param feature_size: of the trunks of actor and critic
    :param net_arch: hidden layers of actor and critic, [1024, 1024] if None; [] is a linear layer after the trunk
    :param frame_stack: frames that the agent sees at once
    :param noise_std: standard deviation of the noise that it explores with
    :param intrinsic: what the agent explores with, not yet built; None for an agent that learns a task
    :param normalize_images: False takes images of any dtype, scaled from their space's bounds instead of from [0, 255]
    :raises ValueError: for spaces or sizes that do not fit
    """

    #: frames that the agent sees at once where nobody says
    usual_frame_stack: ClassVar[int] = 3

    agent: DrQAgent

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
        lr_schedule: Schedule,
        cnn_depth: int = 32,
        feature_size: int = 50,
        net_arch: Sequence[int] | None = None,
        frame_stack: int | None = None,
        noise_std: float = 0.2,
        intrinsic: TransitionReward | None = None,
        normalize_images: bool = True,
    ):
        super().__init__(observation_space, action_space, normalize_images)
        if net_arch is not None and not isinstance(net_arch, Sequence):
            raise ValueError(f"policy_kwargs: net_arch must be a sequence of widths, got {net_arch!r}.")
        net_arch = [1024, 1024] if net_arch is None else list(net_arch)
        frame_stack = self.usual_frame_stack if frame_stack is None else frame_stack
        sizes = {"cnn_depth": cnn_depth, "feature_size": feature_size}
        for name, size in [*sizes.items(), *((f"net_arch[{i}]", width) for i, width in enumerate(net_arch))]:
            if not is_integer(size) or size < 1:
                raise ValueError(f"policy_kwargs: {name} must be a positive integer, got {size!r}.")
        self.agent = DrQAgent(
            self.observations, self.actions.size, frame_stack, net_arch=net_arch, intrinsic=intrinsic, **sizes
        )
        self.frame_stack = frame_stack
        self.noise_std = noise_std
        self.intrinsic = intrinsic
        self._constructor_sizes = {**sizes, "net_arch": net_arch, "frame_stack": frame_stack}

    @classmethod
    def _observations(cls, space: spaces.Space[Any], normalize_images: bool) -> Observations:
        if isinstance(space, spaces.Dict):
            raise UnsupportedSpaceError(
                f"DrQv2 takes no Dict observations, got {space}: gymnasium.wrappers.FlattenObservation makes vectors of them, "
                "and DreamerV2's MultiInputPolicy takes them as they are."
            )
        return super()._observations(space, normalize_images)

    @classmethod
    def _actions(cls, space: spaces.Space[Any]) -> Actions:
        if not isinstance(space, spaces.Box):
            raise UnsupportedSpaceError(f"DrQv2 needs a Box action space, got {space}.")
        return make_actions(space)

    def _get_constructor_parameters(self) -> dict[str, Any]:
        parameters = super()._get_constructor_parameters()
        parameters.update(self._constructor_sizes, lr_schedule=self._dummy_schedule)
        parameters.update(noise_std=self.noise_std, intrinsic=self.intrinsic)
        return parameters

    # -- acting --------------------------------------------------------------------------------------------------------

    def initial_state(self, n: int) -> FrameMemory:
        assert self.observation_space.shape is not None
        frames = th.zeros(n, self.frame_stack, *self.observation_space.shape, device=self.device)
        return FrameMemory(frames, th.zeros(n, self.actions.size, device=self.device))

    def observe(
        self, observation: Observation, state: FrameMemory, is_first: th.Tensor, generator: th.Generator | None = None
    ) -> FrameMemory:
        """Take a frame in; where an episode begins, it fills the whole stack."""
        assert isinstance(observation, th.Tensor)
        newest = observation.unsqueeze(1)
        moved = th.cat([state.frames[:, 1:].to(newest.dtype), newest], 1)
        begins = is_first.view(-1, *[1] * (moved.dim() - 1))
        return FrameMemory(th.where(begins, newest.expand_as(moved), moved), state.action)

    def choose(self, state: FrameMemory, deterministic: bool, generator: th.Generator | None = None) -> FrameMemory:
        """The actor's mean, or a sample of it with noise that is not clipped."""
        std = th.full((), self.noise_std, device=self.device)
        with th.no_grad():
            policy = self.agent.actor(self.agent.encode(state.frames), std)
            return FrameMemory(state.frames, policy.mode if deterministic else policy.sample(generator))

    def _memory_of(self, parts: list[th.Tensor]) -> FrameMemory:
        return FrameMemory(*parts)

    def memory_shapes(self) -> tuple[tuple[int, ...] | None, ...]:
        assert self.observation_space.shape is not None
        return (self.frame_stack, *self.observation_space.shape), (self.actions.size,)


#: the agent for images, and what users write for it
CnnPolicy = DrQPolicy


class MlpPolicy(DrQPolicy):
    """The agent for vectors: Box, MultiBinary, Discrete and MultiDiscrete observations, flattened as in SB3."""

    kind_of_observations: ClassVar[Callable[..., Observations]] = vectors
    usual_frame_stack: ClassVar[int] = 1
