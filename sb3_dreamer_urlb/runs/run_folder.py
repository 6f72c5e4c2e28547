"""Runs that go on after kill -9: a folder with the last checkpoint, and the way back.

``snapshot.zip`` is the checkpoint. It names the files of ``replay/`` that belong to it, so a checkpoint is: write the new
episodes, write the snapshot, rename it, and only then remove what no snapshot names any more (docs/reliability.md, "A run
that goes on"). A kill at any point leaves the checkpoint before or the one after.
"""

from __future__ import annotations

import fcntl
import os
import time
import warnings
import weakref
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch as th
from stable_baselines3.common.vec_env import VecNormalize

from sb3_dreamer_urlb.folders import made_folder
from sb3_dreamer_urlb.number_checks import is_finite_number
from sb3_dreamer_urlb.replay import SequenceReplayBuffer
from sb3_dreamer_urlb.runs import evaluation_history
from sb3_dreamer_urlb.snapshots import model as model_snapshot
from sb3_dreamer_urlb.snapshots import normalization
from sb3_dreamer_urlb.snapshots import replay as replay_snapshot
from sb3_dreamer_urlb.snapshots.archive import CallersError, SnapshotError, blaming, reading
from sb3_dreamer_urlb.snapshots.atomic import TEMPORARY
from sb3_dreamer_urlb.snapshots.saved_algorithm import SavedAlgorithm

Model = TypeVar("Model", bound=SavedAlgorithm)

#: the run folder within the folder that rl_zoo3 keeps a run in
CHECKPOINT = "checkpoint"
#: of the same folder: what Monitor writes about a pre-training in another environment
PRETRAINING_LOGS = "pretraining"
SNAPSHOT, REPLAY, LOCK = "snapshot.zip", "replay", "lock"
FIELDS = {"number", "segments", "open", "evicted", "finished_count", "longest", "evaluation"}
#: of runs whose replay is a store on disk; of those whose checkpoints say when they were written
SOME_HAVE = {"stored", "written"}


@dataclass
class Segment:
    """A file of finished episodes.

    :param name: in the folder ``replay``
    :param end: number of the episode after its last, counted over the whole phase
    """

    name: str
    end: int


class RunFolder:
    """One run on disk, as of its last checkpoint.

    :param path: of the folder
    """

    def __init__(self, path: str | os.PathLike[str]):
        self.path = Path(path)
        self.number = 0
        self.segments: list[Segment] = []
        self.identity: tuple[int, int, int] | None = None
        #: what the evaluation was like when a resumed run was left, until somebody takes it
        self.evaluation: dict[str, Any] | None = None
        self.resumed = False
        #: whether this process has learnt in it
        self.begun = False
        #: of VecNormalize, read and not yet given to an environment that was reset; None if there is nothing to do
        self.statistics: dict[str, th.Tensor] | None = None
        self._buffer: weakref.ref[SequenceReplayBuffer] | None = None

    @property
    def snapshot(self) -> Path:
        """The checkpoint."""
        return self.path / SNAPSHOT

    def is_current(self) -> bool:
        """Whether the checkpoint on disk is the one that this object wrote or read."""
        return self.identity == _identity(self.snapshot)

    def lost_its_checkpoint(self) -> bool:
        """Whether a run's replay lies here without its checkpoint: a file that was moved, half a copy. What a run leaves that
        is killed while it writes its first one does not count."""
        numbers = [file.name.partition(".")[0].partition("-")[0] for file in (self.path / REPLAY).glob("*.zip")]
        return not self.snapshot.exists() and any(name.isdecimal() and int(name) > 1 for name in numbers)

    # -- writing -------------------------------------------------------------------------------------------------------

    def save(self, model: SavedAlgorithm, evaluation: dict[str, Any] | None = None) -> None:
        """Write a checkpoint; only what is new of the replay.

        :param model: between two rollouts, if it is to go on bit for bit
        :param evaluation: what to remember of the evaluation, JSON
        :raises OSError: naming the path; the last checkpoint stays
        """
        buffer, number = model.replay_buffer, self.number + 1
        # Another phase has another replay.
        mine = self._buffer is not None and self._buffer() is buffer
        segments = [segment for segment in self.segments if mine and segment.end > buffer.evicted]
        written = segments[-1].end if segments else 0
        # A store on disk keeps its own rows: only how far it had come.
        buffer.attach()
        stored = None if buffer.disk is None else buffer.evicted + len(buffer.episodes)
        held = buffer.episodes if stored is None else ()
        new = [episode for i, episode in enumerate(held, buffer.evicted) if i >= written]
        if new:
            segments.append(Segment(f"{number:06d}.zip", buffer.evicted + len(buffer.episodes)))
            replay_snapshot.write(buffer, self.path / REPLAY / segments[-1].name, new)
        open_ = [episode for episode in buffer.open if episode is not None]
        open_name = f"{number:06d}-open.zip" if open_ else None
        if open_name is not None:
            replay_snapshot.write(buffer, self.path / REPLAY / open_name, open_)
        run = {
            "number": number,
            "segments": [[segment.name, segment.end] for segment in segments],
            "open": open_name,
            "evicted": buffer.evicted,
            "finished_count": buffer.finished_count,
            "longest": buffer.longest,
            "evaluation": evaluation,
            **({} if stored is None else {"stored": stored}),
            "written": time.time(),
        }
        model_snapshot.save(model, self.snapshot, run)
        self.number, self.segments, self._buffer = number, segments, weakref.ref(buffer)
        self.identity = _identity(self.snapshot)
        self._remove_unnamed(open_name)
        buffer.release()

    def _remove_unnamed(self, open_name: str | None) -> None:
        named = {open_name, *(segment.name for segment in self.segments)}
        folder = self.path / REPLAY
        for file in folder.iterdir() if folder.is_dir() else ():
            if file.name not in named:
                file.unlink()

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other runs out.

        :raises RuntimeError: if another process, or another run of this one, is in the folder
        """
        made_folder("folder", self.path)
        with open(self.path / LOCK, "a+") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                file.seek(0)
                raise RuntimeError(f"Another run (process {file.read().strip() or '?'}) is in {self.path}.") from None
            file.seek(0)
            file.truncate()
            file.write(f"{os.getpid()}\n")
            file.flush()
            # What a killed run left half-written.
            for leftover in self.path.glob(f".*{TEMPORARY}"):
                leftover.unlink()
            yield

    # -- reading -------------------------------------------------------------------------------------------------------

    def restore(self, model: SavedAlgorithm, run: Any, statistics: dict[str, th.Tensor]) -> None:
        """Fill the replay of a model that was loaded from this folder's checkpoint, and its VecNormalize.

        :param model: with an empty replay
        :param run: what :meth:`save` put into the checkpoint
        :param statistics: of VecNormalize, empty without
        :raises SnapshotError: naming the file and why it is refused
        """
        with blaming(str(self.snapshot)):
            if not isinstance(run, dict) or set(run) - SOME_HAVE != FIELDS:
                raise ValueError("it was not saved in a run folder")
            if ("stored" in run) != (model.replay_buffer.path is not None):
                raise ValueError("its replay is kept in another store")
            stored = int(run.get("stored", 0))
            self.number = int(run["number"])
            self.segments = [Segment(_plain_name(name), int(end)) for name, end in run["segments"]]
            open_name = None if run["open"] is None else _plain_name(run["open"])
            numbers = {name: int(run[name]) for name in ("evicted", "finished_count", "longest")}
            self.evaluation = None if run["evaluation"] is None else evaluation_history.checked(run["evaluation"])
            normalizer = model.get_vec_normalize_env()
            if normalizer is not None and statistics:
                normalization.restore(normalizer, statistics)
            self.statistics = statistics
        buffer = model.replay_buffer
        folder = self.path / REPLAY
        if buffer.path is not None:
            buffer.attach(taking_over=True)
            buffer.roll_back(stored, numbers)
            replay_snapshot.close(buffer, [] if open_name is None else replay_snapshot.load_some(buffer, folder / open_name))
            self._restored(buffer)
            return
        episodes = [e for segment in self.segments for e in replay_snapshot.load_some(buffer, folder / segment.name)]
        open_ = [] if open_name is None else replay_snapshot.load_some(buffer, folder / open_name)
        first = self.segments[-1].end - len(episodes) if self.segments else numbers["evicted"]
        if first > numbers["evicted"]:
            raise SnapshotError(f"{folder} lacks episodes that {self.snapshot} names.")
        replay_snapshot.restore(buffer, episodes[numbers["evicted"] - first :], open_, numbers)
        self._restored(buffer)

    def restore_normalization(self, normalizer: VecNormalize | None, restart: Callable[[], None]) -> None:
        """Give the statistics to the environment that the run goes on in, which has just been reset.

        What the reset added to them is undone: the observation that it stands for was counted when the run was left.

        :param normalizer: of the environment, None without
        :param restart: resets it once more
        :raises ValueError: if the environment has no VecNormalize
        """
        if self.statistics is None:
            return
        if normalizer is None and self.statistics:
            raise ValueError(f"The run in {self.path} normalises with VecNormalize, its environment is wrapped in none now.")
        if normalizer is not None and not self.statistics:
            warnings.warn(f"{self.snapshot} holds no statistics of VecNormalize: they begin anew.")
        if normalizer is not None and self.statistics:
            with blaming(str(self.snapshot)):
                self._compare_settings(normalizer, self.statistics)
                normalization.restore(normalizer, self.statistics)
            training, normalizer.training = normalizer.training, False
            restart()
            normalizer.training = training
        self.statistics = None

    def _compare_settings(self, normalizer: VecNormalize, stored: Mapping[str, th.Tensor]) -> None:
        """:raises CallersError: if the environment shows other numbers, or pays others, than the run's did"""
        # rl_zoo3 gives VecNormalize the discount of the model, which may change where a run goes on.
        discount, others = ["gamma"], [name for name in normalization.SETTING_NAMES if name != "gamma"]
        said = "The run in {} normalises with VecNormalize({}), its environment is wrapped in VecNormalize({}) now: {}"
        if texts := normalization.differing(stored, normalizer, others):
            raise CallersError(ValueError(said.format(self.path, *texts, "a run keeps its arguments.")))
        if texts := normalization.differing(stored, normalizer, discount):
            warnings.warn(said.format(self.path, *texts, "rewards are scaled otherwise from here on."))

    def _restored(self, buffer: SequenceReplayBuffer) -> None:
        self._buffer, self.identity = weakref.ref(buffer), _identity(self.snapshot)
        self.resumed = True


def _identity(path: Path) -> tuple[int, int, int] | None:
    try:
        status = path.stat()
    except FileNotFoundError:
        return None
    return status.st_ino, status.st_mtime_ns, status.st_size


def _plain_name(name: Any) -> str:
    if not isinstance(name, str) or Path(name).name != name or not name.endswith(".zip"):
        raise ValueError(f"it names the replay file {str(name)[:80]!r}")
    return name


def written_at(folder: str | os.PathLike[str]) -> float:
    """When the last checkpoint was written, in seconds since 1970: as it says itself, for copies have times of their own.

    :param folder: of a run that has one
    """
    path = Path(folder) / SNAPSHOT
    with suppress(SnapshotError), reading(path, model_snapshot.KIND) as archive:
        said: Any = (archive.data.get("run") or {}).get("written")
        if is_finite_number(said):
            return float(said)
    return path.stat().st_mtime


def _seed_from(seed: int, steps: int) -> int:
    """What an environment is seeded with where a run goes on: the run's own seed would bring the first episodes back, which
    is right only before any step was made.

    :param seed: of the run
    :param steps: agent steps so far
    """
    return seed if steps == 0 else int(np.random.SeedSequence([seed, steps]).generate_state(1)[0]) >> 1


def steps_done(folder: str | os.PathLike[str]) -> int:
    """Agent steps (``num_timesteps``) at the last checkpoint.

    :param folder: of a run that has one
    :raises SnapshotError: naming the file and why it is refused
    """
    with reading(Path(folder) / SNAPSHOT, model_snapshot.KIND) as archive:
        return int(archive.data["counters"]["num_timesteps"])


def resume(algorithm: type[Model], folder: str | os.PathLike[str], env: Any, **kwargs: Any) -> tuple[Model, RunFolder] | None:
    """Go on with a run.

    :param algorithm: class of the model
    :param folder: of the run
    :param env: environment to go on in
    :param kwargs: of :func:`sb3_dreamer_urlb.snapshots.model.load`
    :return: the model with its replay, and the folder; None if there is no checkpoint yet
    :raises NotADirectoryError: for a file
    """
    if os.path.isfile(folder):
        raise NotADirectoryError(
            f"resume() takes the folder of a run, got the file {os.fspath(folder)!r}: {algorithm.__name__}.load reads it."
        )
    run_folder = RunFolder(folder)
    if not run_folder.snapshot.exists():
        return None
    with run_folder.locked():
        model, run, statistics = model_snapshot.load(algorithm, run_folder.snapshot, env, resume=True, **kwargs)
        run_folder.restore(model, run, statistics)
    if model.env is not None and model.seed is not None:
        model.env.seed(_seed_from(model.seed, model.num_timesteps))
    return model, run_folder
