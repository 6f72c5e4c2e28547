"""The networks of one DrQ-v2 agent, in one module: what snapshots hold and transfers copy."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import torch as th
from torch import nn

from sb3_dreamer_urlb.drq_v2.augmentation import random_shift
from sb3_dreamer_urlb.drq_v2.networks import Actor, Critic, PixelEncoder, VectorEncoder
from sb3_dreamer_urlb.intrinsic import EncoderSizes, TransitionReward
from sb3_dreamer_urlb.spaces.observations import Images, Observations, Vectors
from sb3_dreamer_urlb.types import Observation


class DrQAgent(nn.Module):
    """Encoder, actor, critic with its target and, while exploring, the intrinsic reward.

    :param observations: what a frame is: images or vectors
    :param action_size: A
    :param frame_stack: frames an observation has
    :param cnn_depth: channels of the encoder's convolutions
    :param feature_size: of the trunks of actor and critic
    :param net_arch: hidden layers of actor and critic; the last one's width (without any, ``feature_size``) is that of the
        intrinsic reward's networks, too
    :param intrinsic: what it explores with, not yet built; None for an agent that learns a task
    """

    def __init__(
        self,
        observations: Observations,
        action_size: int,
        frame_stack: int,
        cnn_depth: int,
        feature_size: int,
        net_arch: Sequence[int],
        intrinsic: TransitionReward | None,
    ):
        super().__init__()
        self.observations = observations
        self.encoder: PixelEncoder | VectorEncoder
        if isinstance(observations, Images):
            channels, height, width = observations.shape
            self.encoder = PixelEncoder(frame_stack * channels, height, width, cnn_depth)
        else:
            assert isinstance(observations, Vectors)
            self.encoder = VectorEncoder(frame_stack * observations.size)
        size = self.encoder.size
        self.actor = Actor(size, action_size, feature_size, net_arch)
        self.critic = Critic(size, action_size, feature_size, net_arch)
        self.target_critic = copy.deepcopy(self.critic).requires_grad_(False)
        self.intrinsic = copy.deepcopy(intrinsic)
        if self.intrinsic is not None:
            self.intrinsic.build(EncoderSizes(size, action_size, [feature_size, *net_arch][-1]))

    @property
    def explores(self) -> bool:
        """Whether it makes its own rewards."""
        return self.intrinsic is not None

    def prepare(self, frames: Observation, augment: bool) -> th.Tensor:
        """What the encoder sees of stacks of frames.

        :param frames: as the environment gave them, (B, s, …)
        :param augment: shift images at random
        :return: images, float (B, s · C, height, width), or vectors, float (B, s · size)
        """
        assert isinstance(frames, th.Tensor)
        if isinstance(self.observations, Images):
            images = frames.flatten(1, 2)
            prepared = self.observations.preprocess(random_shift(images) if augment else images)
        else:
            prepared = self.observations.preprocess(frames)
            assert isinstance(prepared, th.Tensor)
            prepared = prepared.flatten(1)
        assert isinstance(prepared, th.Tensor)
        return prepared

    def encode(self, frames: Observation, augment: bool = False) -> th.Tensor:
        """Stacks of frames, (B, s, …), → float (B, E).

        :param frames: as the environment gave them
        :param augment: shift images at random
        """
        encoding: th.Tensor = self.encoder(self.prepare(frames, augment))
        return encoding
