"""What a file needs to know of an algorithm: its parts by name, and how to build them anew."""

from __future__ import annotations

import inspect
import itertools
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from importlib import import_module
from types import MappingProxyType
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy

from sb3_dreamer_urlb.replay import SequenceReplayBuffer
from sb3_dreamer_urlb.signatures import named_parameters
from sb3_dreamer_urlb.snapshots import normalization

#: constructor arguments that are the loader's business
NOT_STORED = {"self", "policy", "env", "device", "_init_setup_model"}
#: arguments whose attribute SB3 calls otherwise
ATTRIBUTES = {"stats_window_size": "_stats_window_size"}
#: whether a constructor builds networks, where it is not told by ``_init_setup_model``
_builds: ContextVar[bool] = ContextVar("_builds", default=True)


@contextmanager
def without_networks() -> Iterator[None]:
    """Inside, no constructor builds any: those of subclasses may not hand ``_init_setup_model`` on."""
    before = _builds.set(False)
    try:
        yield
    finally:
        _builds.reset(before)


def builds_networks() -> bool:
    """Whether a constructor may build them now."""
    return _builds.get()


class SavedAlgorithm(OffPolicyAlgorithm):
    """An off-policy algorithm of Stable-Baselines3 whose files hold arguments, counters and tensors, and no code.

    A model is read in three steps: :meth:`_prepare` with the file's arguments, :meth:`_new_policy` without memory to compare
    the sizes of its tensors, and :meth:`_build` to fill.
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]]
    #: arguments of policies and replays that the algorithm fills in itself
    filled_in: ClassVar[frozenset[str]] = frozenset()
    replay_buffer: SequenceReplayBuffer
    #: a key of :data:`sb3_dreamer_urlb.phases.PHASES`
    phase: str
    #: of the environment's task, None where it does not tell
    domain: str | None
    #: ``<domain>-<task>`` whose rewards it has learnt from last; None before, and of older files
    learnt_task: str | None
    #: the set of hyperparameters that filled in what the caller left out
    preset: str
    #: of ``KEPT``: whether the fine-tuning began with the pre-trained one; None where nobody knows
    kept: dict[str, bool] | None
    #: of the VecNormalize that it learnt behind, as a file had them; empty without
    loaded_statistics: Mapping[str, th.Tensor] = MappingProxyType({})

    def known_statistics(self) -> Mapping[str, th.Tensor]:
        """Statistics and settings of the VecNormalize that the model has learnt behind."""
        return self.loaded_statistics if self.env is None else normalization.pack_whole(self._vec_normalize_env)

    @abstractmethod
    def _prepare(self) -> None:
        """Everything of the set-up that builds nothing yet.

        :raises ValueError: for arguments or spaces that do not fit
        """

    @abstractmethod
    def _new_policy(self) -> BasePolicy:
        """The policy of the current phase, its weights fresh; changes nothing of the model."""

    @abstractmethod
    def _build(self) -> None:
        """Fresh networks, optimisers and replay for the current phase."""

    @abstractmethod
    def adams(self) -> dict[str, th.optim.Adam]:
        """What holds the moments of each trained part; the names are those in files."""

    def take_over_changes(self) -> None:
        """Arguments that were changed in a way that the model did not hear of are in force from now on, or refused."""

    @classmethod
    def argument_names(cls) -> list[str]:
        """The constructor arguments that files hold: its own, and those that it decides for the class that it extends."""
        return [name for name in cls.argument_parameters() if name not in NOT_STORED]

    @classmethod
    def argument_parameters(cls) -> dict[str, inspect.Parameter]:
        """All constructor arguments by name, its own first, through constructors that do not hand them on, too."""
        found: dict[str, inspect.Parameter] = {}
        for kind in itertools.takewhile(lambda kind: not inspect.isabstract(kind), cls.__mro__):
            found = {**named_parameters(kind), **found}
        return found

    @classmethod
    def names_within(cls) -> dict[str, set[str]]:
        """Dictionaries among the constructor arguments, and what they may hold, for messages about what is none of these."""
        policies: list[type] = [*cls.policy_aliases.values()]
        kinds: dict[str, list[type]] = {"policy_kwargs": policies, "replay_buffer_kwargs": [SequenceReplayBuffer]}
        return {
            which: {name for kind in each for name in named_parameters(kind)} - cls.filled_in for which, each in kinds.items()
        }

    def arguments(self) -> dict[str, Any]:
        """The constructor arguments, as the model has them now; without those that a subclass keeps nowhere."""
        attributes = {name: ATTRIBUTES.get(name, name) for name in self.argument_names()}
        return {name: getattr(self, attribute) for name, attribute in attributes.items() if hasattr(self, attribute)}


def public_algorithms() -> list[type[SavedAlgorithm]]:
    """Those that this package offers, for messages; imported now, for who loads a file has asked for one of them only."""
    package = import_module(__name__.partition(".")[0])
    kinds = [getattr(package, name) for name in package.__all__]
    return [kind for kind in kinds if isinstance(kind, type) and issubclass(kind, SavedAlgorithm)]
