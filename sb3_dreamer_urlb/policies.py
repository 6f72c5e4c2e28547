"""Observation → latent state → action: what ``predict()`` runs."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule

from sb3_dreamer_urlb import precision as precisions
from sb3_dreamer_urlb.agent import Agent, PlannedAgent
from sb3_dreamer_urlb.intrinsic.base import IntrinsicReward
from sb3_dreamer_urlb.number_checks import is_integer
from sb3_dreamer_urlb.planning import DynaMPC
from sb3_dreamer_urlb.snapshots import policy as policy_snapshot
from sb3_dreamer_urlb.snapshots.archive import Target
from sb3_dreamer_urlb.types import LatentState
from sb3_dreamer_urlb.world_model.world_model import WorldModel

IMAGE_SIZES = (16, 512)
# Deterministic predictions draw their posterior states and planning noise from this seed, always the same.
DETERMINISTIC_SEED = 0

SelfDreamerPolicy = TypeVar("SelfDreamerPolicy", bound="DreamerPolicy")


@dataclasses.dataclass
class ActingState:
    """What an acting agent remembers from one step to the next, for n environments.

    :param latent: posterior state, (n, …)
    :param action: the last action as executed, float (n, A) in [-1, 1]
    :param plan: the planner's mean, float (n, H, A); H is 0 without a planner
    :param skill: that is being followed, float (n, W); W is 0 without skills
    :param steps: observations since the episode began, int64 (n,)
    """

    latent: LatentState
    action: th.Tensor
    plan: th.Tensor
    skill: th.Tensor
    steps: th.Tensor

    def to_numpy(self) -> tuple[np.ndarray, ...]:
        """The form that SB3 hands through ``predict(state=…)``: arrays with leading n."""
        parts = (self.latent.stoch, self.latent.deter, self.action, self.plan, self.skill, self.steps)
        return tuple(part.cpu().numpy() for part in parts)


class DreamerPolicy(BasePolicy):
    """The agent's networks behind SB3's policy interface, for image observations and Box actions.

    :param observation_space: one uint8 image, channels first or last
    :param action_space: Box with finite bounds
    :param lr_schedule: unused here (the learner owns the optimisers), part of SB3's interface
    :param deter_size: D, size of the deterministic state
    :param hidden_size: width of the RSSM's hidden layers
    :param stoch_variables: S categoricals in the stochastic state
    :param stoch_classes: K classes each
    :param cnn_depth: channels of the first convolution
    :param net_arch: hidden layers of every head, actor and critic, [400] * 4 if None
    :param gamma: discount factor
    :param discount_head: learn which states terminate
    :param intrinsic: what the agent explores with, not yet built; None for an agent that learns a task
    :param explores: the intrinsic reward drives the actor; False leaves only its skills in use
    :param planner: what acts instead of the actor while ``planning`` is true
    :param planning: let the planner act
    :param precision: of the planner's products, see :class:`~sb3_dreamer_urlb.DreamerV2`; all else here is float32
    :param normalize_images: part of SB3's interface; uint8 images are always scaled to [-0.5, 0.5]
    :raises ValueError: for spaces or sizes that do not fit
    """

    def __init__(
        self,
        observation_space: spaces.Space,
        action_space: spaces.Space,
        lr_schedule: Schedule,
        deter_size: int = 200,
        hidden_size: int = 200,
        stoch_variables: int = 32,
        stoch_classes: int = 32,
        cnn_depth: int = 48,
        net_arch: Sequence[int] | None = None,
        gamma: float = 0.99,
        discount_head: bool = False,
        intrinsic: IntrinsicReward | None = None,
        explores: bool = True,
        planner: DynaMPC | None = None,
        planning: bool = True,
        precision: str = "float32",
        normalize_images: bool = True,
    ):
        super().__init__(observation_space, action_space, normalize_images=normalize_images)
        if net_arch is not None and not isinstance(net_arch, Sequence):
            raise ValueError(f"policy_kwargs: net_arch must be a sequence of widths, got {net_arch!r}.")
        net_arch = [400] * 4 if net_arch is None else list(net_arch)
        sizes = {
            "deter_size": deter_size,
            "hidden_size": hidden_size,
            "stoch_variables": stoch_variables,
            "stoch_classes": stoch_classes,
            "cnn_depth": cnn_depth,
        }
        for name, size in [*sizes.items(), *((f"net_arch[{i}]", width) for i, width in enumerate(net_arch))]:
            if not is_integer(size) or size < 1:
                raise ValueError(f"policy_kwargs: {name} must be a positive integer, got {size!r}.")
        if len(net_arch) == 0:
            raise ValueError("policy_kwargs: net_arch must name at least one hidden layer, got [].")
        world_model = WorldModel(
            image_shape=check_image_space(observation_space),
            action_size=spaces.flatdim(action_space),
            net_arch=net_arch,
            gamma=gamma,
            discount_head=discount_head,
            **sizes,
        )
        self.agent = Agent(world_model, net_arch, intrinsic, explores)
        self.intrinsic = intrinsic
        self.planner = planner
        self.planning = planning
        self.precision = precision
        self._constructor_sizes = {**sizes, "net_arch": net_arch, "gamma": gamma, "discount_head": discount_head}

    def _get_constructor_parameters(self) -> dict[str, Any]:
        parameters = super()._get_constructor_parameters()
        parameters.update(
            self._constructor_sizes, lr_schedule=self._dummy_schedule, planner=self.planner, planning=self.planning
        )
        parameters.update(precision=self.precision)
        parameters.update(intrinsic=self.intrinsic, explores=self.agent.explores)
        return parameters

    @property
    def planner_dtype(self) -> th.dtype:
        """Format of the planner's products."""
        return precisions.choose(self.precision, "planner", self.device, self.agent.world_model.sizes.feature)

    # -- saving --------------------------------------------------------------------------------------------------------

    def save(self, path: Target) -> None:  # type: ignore[override]
        """Write the policy, in a form that can never run code.

        :param path: path, taken as it is, or binary file object
        """
        policy_snapshot.save(self, path)

    @classmethod
    def load(  # type: ignore[override]
        cls: type[SelfDreamerPolicy],
        path: Target,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
    ) -> SelfDreamerPolicy:
        """Read what :meth:`save` wrote.

        :param path: path or binary file object
        :param device: where to put it
        :param custom_objects: constructor arguments that no file can hold, as an intrinsic reward that is not registered
        :raises SnapshotError: naming the file and why it is refused
        """
        return policy_snapshot.load(cls, path, device, custom_objects)

    # -- acting --------------------------------------------------------------------------------------------------------

    def initial_state(self, n: int) -> ActingState:
        """The memory of n agents that have seen nothing yet."""
        latent = self.agent.world_model.rssm.initial(n)
        action = latent.deter.new_zeros(n, self.agent.actor.action_size)
        skill = latent.deter.new_zeros(n, 0 if self.agent.skills is None else self.agent.skills.dim)
        steps = th.zeros(n, dtype=th.int64, device=self.device)
        return ActingState(latent, action, self._empty_plan(n), skill, steps)

    def _empty_plan(self, n: int) -> th.Tensor:
        horizon = 0 if self.planner is None else self.planner.config.horizon
        return th.zeros(n, horizon, self.agent.actor.action_size, device=self.device)

    def observe(
        self, observation: th.Tensor, state: ActingState, is_first: th.Tensor, generator: th.Generator | None = None
    ) -> ActingState:
        """Take an observation in: one posterior step.

        :param observation: uint8 (n, C, height, width)
        :param state: the memory before it
        :param is_first: bool (n,), true where an episode begins
        :param generator: source of randomness
        """
        model = self.agent.world_model
        embed = model.encoder(model.preprocess(observation))
        latent = model.rssm.posterior_step(state.latent, state.action, embed, is_first, generator)
        plan = state.plan if state.plan.shape[1:] == self._empty_plan(0).shape[1:] else self._empty_plan(len(embed))
        plan = plan * (~is_first).to(plan.dtype).view(-1, 1, 1)
        steps = state.steps * ~is_first
        return ActingState(latent, state.action, plan, self._skill_to_follow(state.skill, steps, generator), steps + 1)

    def _skill_to_follow(self, skill: th.Tensor, steps: th.Tensor, generator: th.Generator | None) -> th.Tensor:
        """The fixed skill; without one, a new random one every ``skills.interval`` steps (spec/algorithms §6)."""
        skills = self.agent.skills
        if skills is None:
            return skill
        fresh = skills.sample(skill.shape[0], self._moved_on(generator, steps))
        renew = steps % skills.interval == 0 if not skills.is_fixed else th.ones_like(steps, dtype=th.bool)
        return th.where(renew.unsqueeze(-1), fresh, skill)

    def _moved_on(self, generator: th.Generator | None, steps: th.Tensor) -> th.Generator | None:
        """For draws that must differ from step to step even where equal inputs give equal actions."""
        return generator and th.Generator(self.device).manual_seed(DETERMINISTIC_SEED + int(steps.sum()))

    def choose(self, state: ActingState, deterministic: bool, generator: th.Generator | None = None) -> ActingState:
        """Choose the next action, with the planner if it is on, with the actor otherwise; at random if it never learns.

        :param state: the memory after :meth:`observe`
        :param deterministic: the actor's mean, or a plan without exploration noise
        :param generator: source of randomness
        :return: the memory with the chosen action
        """
        plan, skill = state.plan, state.skill
        if self.agent.acts_randomly():
            generator = self._moved_on(generator, state.steps)
            action = 2 * th.rand(state.action.shape, generator=generator, device=self.device) - 1
        elif self.planner is not None and self.planning:
            planned = PlannedAgent(self.agent, skill)
            with precisions.products(self.device, self.planner_dtype):
                action, plan = self.planner.plan(planned, state.latent, plan, generator, explore=not deterministic)
        else:
            policy = self.agent.actor(state.latent.feature, skill if self.agent.skills is not None else None)
            action = policy.mean if deterministic else policy.sample(generator)
        return dataclasses.replace(state, action=action, plan=plan)

    # -- SB3's interface -----------------------------------------------------------------------------------------------

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Action for each observation; never changes the policy, all memory travels in ``state``.

        :param observation: uint8 image(s), (height, width, C) or (C, height, width), with or without leading n
        :param state: what the last call returned; None starts afresh
        :param episode_start: bool (n,), true where a new episode begins
        :param deterministic: mean action (or plan without exploration noise); draws of the posterior and the planner
            then come from a fixed seed, so equal inputs give equal actions and the global generators stay untouched
        :return: action(s) in the action space, and the memory for the next call: arrays with leading n (1 if unbatched)
        """
        self.set_training_mode(False)
        if isinstance(observation, tuple):
            raise ValueError("predict() takes the observation, got a tuple: Gymnasium's `obs, info = env.reset()`?")
        tensor, vectorized = self.obs_to_tensor(observation)
        assert isinstance(tensor, th.Tensor)
        if tensor.dtype != th.uint8:
            raise ValueError(f"Images must be uint8 in [0, 255], got {tensor.dtype}.")
        n = tensor.shape[0]
        memory = self.initial_state(n) if state is None else self._memory(state, n)
        starts = np.zeros(n, bool) if episode_start is None else np.array(episode_start, bool).reshape(-1)
        if len(starts) != n:
            raise ValueError(f"episode_start has {len(starts)} entries for {n} observation(s).")
        generator = th.Generator(self.device).manual_seed(DETERMINISTIC_SEED) if deterministic else None
        is_first = th.as_tensor(starts | (state is None), device=self.device)
        with th.no_grad():
            memory = self.choose(self.observe(tensor, memory, is_first, generator), deterministic, generator)
        action = self.to_env_action(memory.action.cpu().numpy())
        return action if vectorized else action[0], memory.to_numpy()

    def to_env_action(self, action: np.ndarray) -> np.ndarray:
        """From [-1, 1], (n, A), to the action space's bounds, shape and dtype."""
        space = self.action_space
        assert isinstance(space, spaces.Box)
        unscaled = self.unscale_action(action.reshape((-1, *space.shape)))
        return np.clip(unscaled, space.low, space.high).astype(space.dtype)

    def _memory(self, state: tuple[np.ndarray, ...], n: int) -> ActingState:
        if not isinstance(state, tuple) or len(state) != 6:
            raise ValueError(f"state must be what the last predict() returned, a tuple of 6 arrays, got {type(state)}.")
        if any(len(part) != n for part in state):
            raise ValueError(f"state is for {[len(part) for part in state]} environments, the observation for {n}.")
        stoch, deter, action, plan, skill, steps = (th.as_tensor(part, device=self.device) for part in state)
        return ActingState(LatentState(stoch, deter), action, plan, skill, steps)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        assert isinstance(observation, th.Tensor)
        n = observation.shape[0]
        is_first = th.ones(n, dtype=th.bool, device=self.device)
        return self.choose(self.observe(observation, self.initial_state(n), is_first), deterministic).action

    def forward(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """Actions in [-1, 1] at the beginning of an episode, (n, A)."""
        return self._predict(observation, deterministic)


def check_image_space(space: spaces.Space) -> tuple[int, int, int]:
    """Shape of the images, channels first.

    :raises ValueError: if the space is not one uint8 image, channels first, square, and of a size the networks take
    """
    if not isinstance(space, spaces.Box) or not is_image_space(space):
        raise ValueError(
            "CnnPolicy needs image observations: Box(0, 255, (height, width, channels), uint8), "
            f"got {space}. For dm_control tasks use gymnasium.make('urlb/<domain>-<task>-v0')."
        )
    channels, height, width = space.shape
    low, high = IMAGE_SIZES
    if height != width or not low <= height <= high:
        raise ValueError(f"Images must be square, {low} to {high} pixels wide, got {height}×{width}: resize them.")
    return channels, height, width


#: what users write
CnnPolicy = DreamerPolicy
