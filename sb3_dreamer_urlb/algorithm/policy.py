"""What every agent of this package is as a policy of Stable-Baselines3: it has a memory, and its files run no code."""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections.abc import Callable, Iterator
from typing import Any, ClassVar, Generic, Protocol, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import PyTorchObs
from torch import nn

from sb3_dreamer_urlb.algorithm.prediction_checks import checked_starts, checked_state, observed
from sb3_dreamer_urlb.number_checks import check_switch, plain
from sb3_dreamer_urlb.snapshots import policy as policy_snapshot
from sb3_dreamer_urlb.snapshots.archive import Target
from sb3_dreamer_urlb.spaces.actions import Actions, make_actions
from sb3_dreamer_urlb.spaces.observation_checks import checked_observation
from sb3_dreamer_urlb.spaces.observations import Images, Observations
from sb3_dreamer_urlb.types import Observation, batch_size

SelfAgentPolicy = TypeVar("SelfAgentPolicy", bound="AgentPolicy[Any]")


class Memory(Protocol):
    """What an acting agent remembers from one step to the next, for n environments."""

    #: the last action, float (n, A) in [-1, 1], or one-hot
    action: th.Tensor

    def to_numpy(self) -> tuple[np.ndarray, ...]:
        """The form that SB3 hands through ``predict(state=…)``: arrays with leading n."""


AnyMemory = TypeVar("AnyMemory", bound=Memory)


def _known_policies(of: type[Any] | None = None) -> Iterator[type[Any]]:
    """Those of this package that were imported so far, for messages."""
    for kind in (AgentPolicy if of is None else of).__subclasses__():
        if kind.__module__.startswith(f"{__name__.split('.')[0]}."):
            yield kind
        yield from _known_policies(kind)


class AgentPolicy(BasePolicy, Generic[AnyMemory]):
    """An agent's networks behind SB3's policy interface: observe, remember, choose.

    :param observation_space: see :attr:`kind_of_observations`
    :param action_space: what :func:`~sb3_dreamer_urlb.spaces.actions.make_actions` takes
    :param normalize_images: False takes images of any dtype, scaled from their space's bounds instead of from [0, 255]
    :raises ValueError: for spaces that do not fit
    """

    #: from an observation space, and ``normalize_images``, to what the agent sees; raises UnsupportedSpaceError
    kind_of_observations: ClassVar[Callable[..., Observations]] = Images
    agent: nn.Module
    _types: tuple[np.dtype[Any], ...] | None = None

    def __init__(self, observation_space: spaces.Space[Any], action_space: spaces.Space[Any], normalize_images: bool):
        check_switch("policy_kwargs: normalize_images", normalize_images)
        super().__init__(observation_space, action_space, normalize_images=normalize_images)
        self.observations = self._observations(observation_space, normalize_images)
        self.actions = self._actions(action_space)

    @classmethod
    def check_spaces(
        cls, observation_space: spaces.Space[Any], action_space: spaces.Space[Any], normalize_images: bool = True
    ) -> None:
        """Warns of a space that may be meant otherwise.

        :raises UnsupportedSpaceError: for a space that this policy does not take
        """
        for doubt in cls._observations(observation_space, normalize_images).doubts:
            warnings.warn(doubt)
        cls._actions(action_space)

    @classmethod
    def _observations(cls, space: spaces.Space[Any], normalize_images: bool) -> Observations:
        return cls.kind_of_observations(space, normalize_images)

    @classmethod
    def _actions(cls, space: spaces.Space[Any]) -> Actions:
        return make_actions(space)

    # -- saving --------------------------------------------------------------------------------------------------------

    def save(self, path: Target) -> None:
        """Write the policy, in a form that can never run code.

        :param path: path, taken as it is, or binary file object
        """
        policy_snapshot.save(self, path)

    @classmethod
    def load(
        cls: type[SelfAgentPolicy],
        path: Target,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
    ) -> SelfAgentPolicy:
        """Read what :meth:`save` wrote.

        :param path: path or binary file object
        :param device: where to put it
        :param custom_objects: constructor arguments that no file can hold, as an intrinsic reward that is not registered
        :raises SnapshotError: naming the file and why it is refused
        """
        return policy_snapshot.load(cls, path, device, custom_objects, _known_policies())

    # -- acting --------------------------------------------------------------------------------------------------------

    @abstractmethod
    def initial_state(self, n: int) -> AnyMemory:
        """The memory of n agents that have seen nothing yet."""

    @abstractmethod
    def observe(
        self, observation: Observation, state: AnyMemory, is_first: th.Tensor, generator: th.Generator | None = None
    ) -> AnyMemory:
        """Take an observation in.

        :param observation: as the environment gave it, (n, …)
        :param state: the memory before it
        :param is_first: bool (n,), true where an episode begins
        :param generator: source of randomness
        """

    @abstractmethod
    def choose(self, state: AnyMemory, deterministic: bool, generator: th.Generator | None = None) -> AnyMemory:
        """Choose the next action.

        :param state: the memory after :meth:`observe`
        :param deterministic: without exploration
        :param generator: source of randomness
        :return: the memory with the chosen action
        """

    @abstractmethod
    def _memory_of(self, parts: list[th.Tensor]) -> AnyMemory:
        """Undo ``to_numpy``."""

    @abstractmethod
    def memory_shapes(self) -> tuple[tuple[int, ...] | None, ...]:
        """Of the arrays in ``predict(state=…)``, without the leading n; None where any will do."""

    # -- SB3's interface -----------------------------------------------------------------------------------------------

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Action for each observation; never changes the policy, all memory travels in ``state``.

        :param observation: from the observation space, with or without leading n; uint8 images with channels first or last
        :param state: what the last call returned; None starts afresh
        :param episode_start: bool (n,), true where a new episode begins
        :param deterministic: the agent's best action (or plan), without exploration; whatever is drawn for it, as posterior
            states and plans, then comes from the environments' step counts, which travel in ``state``: equal inputs give
            equal actions, the steps of an episode draw independently, and the global generators stay untouched
        :return: action(s) in the action space, and the memory for the next call: arrays with leading n (1 if unbatched)
        :raises ValueError: for an observation out of its space, and a state, starts or a switch that cannot be meant
        """
        check_switch("deterministic", deterministic := plain(deterministic))
        self.set_training_mode(False)
        tensor, vectorized = self.obs_to_tensor(checked_observation(observation, self.observation_space))
        self.observations.check(tensor)
        n = observed(tensor)
        if state is None:
            memory = self.initial_state(n)
        else:
            state = checked_state(state, n, self.memory_shapes(), self._memory_types())
            memory = self._memory_of([th.as_tensor(part, device=self.device) for part in state])
        starts = checked_starts(episode_start, n)
        generator = self._generator_of(state, starts) if deterministic else None
        is_first = th.as_tensor(starts | (state is None), device=self.device)
        with th.no_grad():
            memory = self.choose(self.observe(tensor, memory, is_first, generator), deterministic, generator)
        action = self.to_env_action(memory.action.cpu().numpy())
        # An array in any case, as SB3's: indexing would make a scalar of a single choice.
        return action if vectorized else action.squeeze(0), memory.to_numpy()

    def _memory_types(self) -> tuple[np.dtype[Any], ...]:
        """Of the arrays in ``predict(state=…)``."""
        if self._types is None:
            self._types = tuple(part.dtype for part in self.initial_state(1).to_numpy())
        return self._types

    def _generator_of(self, state: tuple[np.ndarray, ...] | None, starts: np.ndarray) -> th.Generator | None:
        """What a deterministic prediction draws from; None for agents that draw nothing.

        :param state: what the last call of ``predict`` returned; None at the beginning
        :param starts: where episodes begin, bool (n,)
        """
        return None

    def to_env_action(self, action: np.ndarray) -> np.ndarray:
        """From the agent's actions, (n, A), to the action space's bounds, shape and dtype."""
        return self.actions.to_env(action)

    def _predict(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        n = batch_size(observation)
        is_first = th.ones(n, dtype=th.bool, device=self.device)
        generator = self._generator_of(None, np.ones(n, bool)) if deterministic else None
        state = self.observe(observation, self.initial_state(n), is_first, generator)
        return self.choose(state, deterministic, generator).action

    def forward(self, observation: PyTorchObs, deterministic: bool = False) -> th.Tensor:
        """The agent's actions at the beginning of an episode, (n, A): those of :meth:`predict` before the space's form.

        :param observation: tensors, (n, …), images with channels first
        :param deterministic: without exploration, and with equal draws for equal inputs
        """
        return self._predict(observation, deterministic)
