"""Observation → latent state → action: what ``predict()`` runs."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.type_aliases import Schedule

from sb3_dreamer_urlb import native
from sb3_dreamer_urlb.agent import Agent
from sb3_dreamer_urlb.algorithm.policy import AgentPolicy
from sb3_dreamer_urlb.intrinsic.base import IntrinsicReward
from sb3_dreamer_urlb.learning.graphs import Recorder, make_backend, memory_of
from sb3_dreamer_urlb.nn import precision as precisions
from sb3_dreamer_urlb.number_checks import is_integer
from sb3_dreamer_urlb.planning import Planner
from sb3_dreamer_urlb.planning.prepared.agent import planned
from sb3_dreamer_urlb.spaces.observations import DictObservations, Observations, vectors
from sb3_dreamer_urlb.types import LatentState, Observation
from sb3_dreamer_urlb.world_model.world_model import WorldModel

# Deterministic predictions draw their posterior states and planning noise from seeds that begin with this number.
DETERMINISTIC_SEED = 0

# Recordings of acting to keep at a time: one and ten environments, with and without exploration.
KEPT_RECORDINGS = 4


@dataclasses.dataclass
class ActingState:
    """What an acting agent remembers from one step to the next, for n environments.

    :param latent: posterior state, (n, …)
    :param action: the last action as executed, float (n, A) in [-1, 1], or one-hot
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


class DreamerPolicy(AgentPolicy[ActingState]):
    """The agent's networks behind SB3's policy interface. This class is for images; the two below it for other observations.

    :param observation_space: images, channels first: uint8, or floats without ``normalize_images``
    :param action_space: Box with finite bounds, Discrete or MultiDiscrete
    :param lr_schedule: unused here (the learner owns the optimisers), part of SB3's interface
    :param deter_size: D, size of the deterministic state
    :param hidden_size: width of the RSSM's hidden layers
    :param stoch_variables: S categoricals in the stochastic state
    :param stoch_classes: K classes each
    :param cnn_depth: channels of the first convolution
    :param net_arch: hidden layers of every head, actor, critic, encoder and decoder of vectors, [400] * 4 if None
    :param gamma: discount factor
    :param discount_head: learn which states terminate
    :param intrinsic: what the agent explores with, not yet built; None for an agent that learns a task
    :param explores: the intrinsic reward drives the actor; False leaves only its skills in use
    :param task_reward: while exploring with ICM or RND, learn the task's reward in a head of its own; names of tasks: those of
        all of them, with any method
    :param planner: what acts instead of the actor while ``planning`` is true
    :param planning: let the planner act
    :param precision: of the planner's products, see :class:`~sb3_dreamer_urlb.DreamerV2`; all else here is float32
    :param compile: of acting, see :class:`~sb3_dreamer_urlb.DreamerV2`
    :param normalize_images: False takes images of any dtype, scaled from their space's bounds instead of from [0, 255]
    :raises ValueError: for spaces or sizes that do not fit
    """

    agent: Agent

    def __init__(
        self,
        observation_space: spaces.Space[Any],
        action_space: spaces.Space[Any],
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
        task_reward: bool | Sequence[str] = False,
        planner: Planner | None = None,
        planning: bool = True,
        precision: str = "float32",
        compile: str = "eager",
        normalize_images: bool = True,
    ):
        super().__init__(observation_space, action_space, normalize_images)
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
        if stoch_classes < 2:
            raise ValueError(
                f"policy_kwargs: stoch_classes must be at least 2, for one class says nothing, got {stoch_classes!r}."
            )
        #: widths of the hidden layers; without any, every network that has nothing to convolve is linear
        self.net_arch = net_arch
        if planner is not None and planner.classes != self.actions.classes:
            raise ValueError(f"The planner chooses among the classes {planner.classes}, the actions are {action_space}.")
        world_model = WorldModel(
            observations=self.observations,
            action_size=self.actions.size,
            net_arch=net_arch,
            gamma=gamma,
            discount_head=discount_head,
            **sizes,
        )
        self.agent = Agent(world_model, net_arch, intrinsic, explores, self.actions.classes, task_reward)
        self.intrinsic = intrinsic
        self._plan_with(planner)
        self.planning = planning
        self.precision = precision
        self.compile_mode = compile
        self._recorders: tuple[Recorder[ActingState], Recorder[ActingState]] | None = None
        self._recorders_device = th.device("cpu")
        self._constructor_sizes = {**sizes, "net_arch": net_arch, "gamma": gamma, "discount_head": discount_head}

    def _get_constructor_parameters(self) -> dict[str, Any]:
        parameters = super()._get_constructor_parameters()
        parameters.update(
            self._constructor_sizes, lr_schedule=self._dummy_schedule, planner=self.planner, planning=self.planning
        )
        parameters.update(precision=self.precision, compile=self.compile_mode)
        parameters.update(intrinsic=self.intrinsic, explores=self.agent.explores)
        tasks = self.agent.task_rewards
        parameters.update(task_reward=self.agent.task_reward is not None if tasks is None else list(tasks))
        return parameters

    @property
    def planner(self) -> Planner | None:
        """Who chooses actions while ``planning``; set when the policy is made, so that it is saved and transferred."""
        return self._planner

    @planner.setter
    def planner(self, _: Any) -> None:
        raise AttributeError(
            "A policy's planner is not changed by hand, for the model would save and fine-tune with the old one: "
            "give it to the model, DreamerV2(..., planner=...) or DreamerV2.load(path, planner=...)."
        )

    @property
    def planner_dtype(self) -> th.dtype:
        """Format of the planner's products."""
        return precisions.choose(self.precision, "planner", self.device, self.agent.world_model.sizes.feature)

    def set_numbers(self, gamma: float, planner: Planner | None) -> None:
        """Act with other numbers from now on.

        :param gamma: discount factor
        :param planner: None lets the actor act
        """
        self.agent.world_model.gamma = self._constructor_sizes["gamma"] = gamma
        self._plan_with(planner)
        # A recording holds the old ones.
        self._recorders = None

    def _plan_with(self, planner: Planner | None) -> None:
        self._planner = planner
        if planner is not None:
            planner.in_use = True

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
        self, observation: Observation, state: ActingState, is_first: th.Tensor, generator: th.Generator | None = None
    ) -> ActingState:
        """Take an observation in: one posterior step.

        :param observation: as the environment gave it, (n, …)
        :param state: the memory before it
        :param is_first: bool (n,), true where an episode begins
        :param generator: source of randomness
        """
        with native.using(self.compile_mode, self.device):
            return self._recorded()[0]((observation, state, is_first), generator, (self._skill_is_fixed(),))

    @th.no_grad()
    def _observe(
        self, seen: tuple[Observation, ActingState, th.Tensor], generator: th.Generator | None, *situation: Hashable
    ) -> ActingState:
        observation, state, is_first = seen
        model = self.agent.world_model
        embed = model.encoder(model.preprocess(observation))
        latent = model.rssm.posterior_step(state.latent, state.action, embed, is_first, generator)
        plan = state.plan if state.plan.shape[1:] == self._empty_plan(0).shape[1:] else self._empty_plan(len(embed))
        plan = plan * (~is_first).to(plan.dtype).view(-1, 1, 1)
        steps = state.steps * ~is_first
        return ActingState(latent, state.action, plan, self._skill_to_follow(state.skill, steps, generator), steps + 1)

    def _skill_to_follow(self, skill: th.Tensor, steps: th.Tensor, generator: th.Generator | None) -> th.Tensor:
        """The fixed skill; without one, a new random one every ``skills.interval`` steps (docs/algorithm.md, "Skills")."""
        skills = self.agent.skills
        if skills is None:
            return skill
        fresh = skills.sample(skill.shape[0], generator)
        renew = steps % skills.interval == 0 if not skills.is_fixed else th.ones_like(steps, dtype=th.bool)
        return th.where(renew.unsqueeze(-1), fresh, skill)

    def choose(self, state: ActingState, deterministic: bool, generator: th.Generator | None = None) -> ActingState:
        """Choose the next action, with the planner if it is on, with the actor otherwise; at random if it never learns.

        :param state: the memory after :meth:`observe`
        :param deterministic: the actor's most likely action, or a plan without exploration noise
        :param generator: source of randomness
        :return: the memory with the chosen action
        """
        if self.agent.acts_randomly():
            action = self.actions.random(len(state.action), generator, self.device)
            return dataclasses.replace(state, action=action)
        plans = self.planner is not None and self.planning
        with native.using(self.compile_mode, self.device):
            return self._recorded()[1](state, generator, (plans, deterministic))

    @th.no_grad()
    def _choose(self, state: ActingState, generator: th.Generator | None, plans: bool, deterministic: bool) -> ActingState:
        plan, skill = state.plan, state.skill
        if plans:
            assert self.planner is not None
            with precisions.products(self.device, self.planner_dtype):
                model = planned(self.agent, skill)
                chosen = self.planner.plan(model, state.latent, plan, generator, explore=not deterministic)
                action, plan = self.planner.returned("plan", chosen, state.action.shape, plan.shape)
                # The replay is to hold what the environment gets, whatever somebody's own planner proposes.
                action = self.actions.executable(action)
        else:
            policy = self.agent.actor(state.latent.feature, skill if self.agent.skills is not None else None)
            action = policy.mode if deterministic else policy.sample(generator)
        return dataclasses.replace(state, action=action, plan=plan)

    # -- what acting does on the device, recorded if that is wanted and possible -------------------------------------------

    def _recorded(self) -> tuple[Recorder[ActingState], Recorder[ActingState]]:
        """Of :meth:`observe` and of :meth:`choose`; made anew where the networks moved to another device."""
        if self._recorders is None or self._recorders_device != self.device:
            self._recorders_device = self.device
            backend = make_backend(self.compile_mode, self.device)
            self._recorders = (
                Recorder(self._observe, backend, self._acting_memory, "Observing", KEPT_RECORDINGS),
                Recorder(self._choose, backend, self._acting_memory, "Choosing an action", KEPT_RECORDINGS),
            )
        return self._recorders

    def _acting_memory(self) -> Iterator[th.Tensor]:
        """What acting reads besides its inputs."""
        agent = self.agent
        yield from memory_of(agent.world_model, agent.actor, agent.slow_critic, agent.skills)

    def _skill_is_fixed(self) -> bool:
        return self.agent.skills is not None and self.agent.skills.is_fixed

    def _generator_of(self, state: tuple[np.ndarray, ...] | None, starts: np.ndarray) -> th.Generator:
        """Noise of one deterministic step: its own, and the same whenever the same step is predicted.

        With the same numbers at every step, a planner would push each joint into one accidental direction all episode long.

        :param state: what the last call of ``predict`` returned; None at the beginning
        :param starts: where episodes begin, bool (n,)
        """
        begun = np.zeros(len(starts), np.int64) if state is None else np.where(starts, 0, state[-1])
        seed = np.random.SeedSequence([DETERMINISTIC_SEED, *begun.tolist()]).generate_state(1, np.uint64)[0]
        return th.Generator(self.device).manual_seed(int(seed >> np.uint64(1)))

    def _memory_of(self, parts: list[th.Tensor]) -> ActingState:
        stoch, deter, action, plan, skill, steps = parts
        return ActingState(LatentState(stoch, deter), action, plan, skill, steps)

    def memory_shapes(self) -> tuple[tuple[int, ...] | None, ...]:
        rssm, skills = self.agent.world_model.rssm, self.agent.skills
        # A plan of another horizon is begun anew.
        size = 0 if skills is None else skills.dim
        return (rssm.stoch_size,), (rssm.deter_size,), (self.agent.actor.action_size,), None, (size,), ()


#: the agent for images, and what users write for it
CnnPolicy = DreamerPolicy


class MlpPolicy(DreamerPolicy):
    """The agent for vectors: Box, MultiBinary, Discrete and MultiDiscrete observations, flattened as in SB3."""

    kind_of_observations: ClassVar[Callable[..., Observations]] = vectors


class MultiInputPolicy(DreamerPolicy):
    """The agent for Dict observations: images and vectors by name."""

    kind_of_observations: ClassVar[Callable[..., Observations]] = DictObservations
