"""What the algorithm keeps in files, and takes from them."""

from __future__ import annotations

import copy
import os
from abc import abstractmethod
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

import torch as th
from stable_baselines3.common.type_aliases import GymEnv

from sb3_dreamer_urlb.algorithm.checks import check_load_keywords
from sb3_dreamer_urlb.replay import SequenceReplayBuffer
from sb3_dreamer_urlb.runs import run_folder
from sb3_dreamer_urlb.runs.running_algorithm import RunningAlgorithm
from sb3_dreamer_urlb.snapshots import model as model_snapshot
from sb3_dreamer_urlb.snapshots import replay as replay_snapshot
from sb3_dreamer_urlb.snapshots.archive import Target

SelfSavingAlgorithm = TypeVar("SelfSavingAlgorithm", bound="SavingAlgorithm")


class SavingAlgorithm(RunningAlgorithm):
    """Stable-Baselines3's ``save``, ``load`` and their kin, with files that can never run code."""

    @abstractmethod
    def go_on_where_left(self) -> None:
        """Begin without a reset, if a model left the environments where they stand now."""

    @abstractmethod
    def _go_on_normalized(self, known: Mapping[str, th.Tensor]) -> None:
        """Let the environment's VecNormalize take statistics over, or warn, see ``normalized.go_on``."""

    @abstractmethod
    def _new_replay_buffer(self) -> SequenceReplayBuffer:
        """An empty one for the current phase."""

    def save(self, path: Target, exclude: Iterable[str] | None = None, include: Iterable[str] | None = None) -> None:
        """Write the model, without replay and environment, in a form that can never run code.

        :param path: path (``.zip`` is added where it has no suffix; written atomically), or binary file object
        :param exclude: part of SB3's interface; a snapshot is always whole
        :param include: likewise
        :raises ValueError: for ``exclude`` or ``include``, or if a weight is not finite; the old file stays
        :raises OSError: naming the path; the old file stays
        """
        if exclude or include:
            raise ValueError("A snapshot is always whole: save() takes neither exclude nor include.")
        model_snapshot.save(self, path)

    @classmethod
    def load(
        cls: type[SelfSavingAlgorithm],
        path: Target,
        env: GymEnv | str | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        **kwargs: Any,
    ) -> SelfSavingAlgorithm:
        """Read what :meth:`save` wrote. No code ever runs from a file, whoever made it.

        A model with a ``seed`` goes on with the random states of the file, one without draws anew.

        :param path: of the ``.zip``, or a binary file object
        :param env: environment to go on in
        :param device: where to put the networks
        :param custom_objects: arguments that replace the stored ones, needed for those that no file can hold: functions as
            learning rates, classes that are not registered; unknown names are ignored, as SB3 does
        :param print_system_info: print those of the file and of this machine
        :param force_reset: False goes on in the middle of episodes, with ``learn(..., reset_num_timesteps=False)``: if ``env``
            is that of a model that learnt in it in this process and nobody has stepped or reset it since; else it is reset
        :param kwargs: constructor arguments to change; a new ``seed`` also draws anew
        :raises TypeError: for a keyword that is no constructor argument
        :raises SnapshotError: naming the file and why it is refused
        """
        check_load_keywords(cls, kwargs, "load")
        model = model_snapshot.load(cls, path, env, device, custom_objects, print_system_info, kwargs)[0]
        if model.env is not None:
            model._go_on_normalized(model.loaded_statistics)
        if not force_reset:
            model.go_on_where_left()
        return model

    @classmethod
    def resume(
        cls: type[SelfSavingAlgorithm],
        folder: str | os.PathLike[str],
        env: GymEnv | str | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> SelfSavingAlgorithm | None:
        """Go on with a run that a :class:`~sb3_dreamer_urlb.RunCheckpointCallback` kept, replay included.

        Continue with ``learn(total - model.num_timesteps, reset_num_timesteps=False)``.

        :param folder: of the run
        :param env: environment to go on in
        :param device: see :meth:`load`
        :param custom_objects: see :meth:`load`
        :param kwargs: see :meth:`load`
        :return: the model as of the last checkpoint, random states included; None if there is none yet
        :raises SnapshotError: naming the file and why it is refused
        :raises RuntimeError: if the run is still going
        """
        check_load_keywords(cls, kwargs, "resume")
        resumed = run_folder.resume(
            cls, folder, env, device=device, custom_objects=custom_objects, print_system_info=False, kwargs=kwargs
        )
        if resumed is None:
            return None
        model, folder_of_it = resumed
        model.run_folder = folder_of_it
        return model

    def get_parameters(self) -> dict[str, dict[str, Any]]:
        """Weights and the optimisers' moments as they are now: learning on does not change what was got.

        :return: as Stable-Baselines3's, for :meth:`set_parameters` of this model or another one
        """
        self.take_over_changes()
        return copy.deepcopy(super().get_parameters())

    def set_parameters(
        self, load_path_or_dict: Target | dict[str, Any], exact_match: bool = True, device: th.device | str = "auto"
    ) -> None:
        """Take over weights and the optimisers' moments.

        :param load_path_or_dict: what :meth:`save` wrote, or what :meth:`get_parameters` gave
        :param exact_match: False takes what both have
        :param device: part of SB3's interface; the parameters stay where they are
        :raises SnapshotError: naming the file and why it is refused; the model stays as it is
        """
        if isinstance(load_path_or_dict, dict):
            # torch's optimisers keep the tensors that they are handed: two models would share their moments.
            super().set_parameters(copy.deepcopy(load_path_or_dict), exact_match, device)
        else:
            model_snapshot.set_parameters(self, load_path_or_dict, exact_match)

    def save_replay_buffer(self, path: Target) -> None:
        """Write the replay, open episodes included, in a form that can never run code.

        :param path: path (``.zip`` is added where it has no suffix), or binary file object
        :raises FileExistsError: where a model or a policy is kept under that name
        """
        replay_snapshot.save(self.replay_buffer, path)

    def load_replay_buffer(self, path: Target, truncate_last_traj: bool = True) -> None:
        """Go on with a saved replay buffer.

        :param path: what :meth:`save_replay_buffer` wrote
        :param truncate_last_traj: part of SB3's interface; open episodes are always ended
        :raises SnapshotError: if the file is damaged, does not fit the model, or was filled in another phase; the model
            keeps its own then
        """
        buffer = self._new_replay_buffer()
        replay_snapshot.load(buffer, path)
        self.replay_buffer = buffer
