"""Replayed episodes ↔ a file: columns of rows as safetensors, in members that fit into memory many times.

Each ``rows-…`` member holds whole episodes: their lengths and, one after the other, the rows of each column.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.numpy

from sb3_dreamer_urlb.replay import SequenceReplayBuffer
from sb3_dreamer_urlb.replay.episode import Episode
from sb3_dreamer_urlb.snapshots import tensors, values
from sb3_dreamer_urlb.snapshots.archive import Archive, Target, reading, writing
from sb3_dreamer_urlb.snapshots.random_state import generator_state, set_generator

KIND = "replay"
#: bytes that a member should have; one long episode may exceed it
MEMBER_BYTES = 64 << 20
LENGTHS = "lengths"
NUMBERS = ("n_envs", "batch_length", "evicted", "finished_count", "longest")
FIELDS = {*NUMBERS, "observation_space", "action_space", "phase", "sampler", "streams"}


def save(buffer: SequenceReplayBuffer, target: Target) -> None:
    """Write a whole replay buffer; from another thread than the one that fills it, too, but then an episode that ends just now
    may be missing.

    :param buffer: open episodes are stored, too
    :param target: path (``.zip`` is added where it has no suffix), or binary file object
    """
    finished = list(buffer.episodes)
    open_ = {i: episode for i, episode in enumerate(list(buffer.open)) if episode is not None}
    write(buffer, target, [*finished, *open_.values()], list(open_))


def write(buffer: SequenceReplayBuffer, target: Target, episodes: Iterable[Episode], streams: Sequence[int] = ()) -> None:
    """Write some episodes of a buffer.

    :param buffer: describes them
    :param target: see :func:`save`
    :param episodes: in their order
    :param streams: which environment each open episode, the last of them all, belongs to
    """
    with writing(target, KIND) as writer:
        for number, group in enumerate(_groups(episodes)):
            writer.add(f"rows-{number:06d}.safetensors", _pack(buffer, group))
        writer.finish(
            {
                **{name: int(getattr(buffer, name)) for name in NUMBERS},
                "observation_space": values.encode(buffer.observation_space),
                "action_space": values.encode(buffer.action_space),
                "phase": buffer.phase,
                "sampler": generator_state(buffer.rng),
                "streams": list(streams),
            }
        )


def _groups(episodes: Iterable[Episode]) -> Iterator[list[Episode]]:
    group: list[Episode] = []
    size = 0
    for episode in episodes:
        group.append(episode)
        size += len(episode) * sum(rows.nbytes for rows in episode.rows(0, 1).values())
        if size >= MEMBER_BYTES:
            yield group
            group, size = [], 0
    if group:
        yield group


def _pack(buffer: SequenceReplayBuffer, group: list[Episode]) -> bytes:
    # Once for all columns: an open episode may be growing.
    lengths = [len(episode) for episode in group]
    rows = [episode.rows(0, length) for episode, length in zip(group, lengths, strict=True)]
    columns = {name: np.concatenate([part[name] for part in rows]) for name in buffer.columns()}
    columns[LENGTHS] = np.array(lengths, np.int64)
    return safetensors.numpy.save(columns)


# -- loading ---------------------------------------------------------------------------------------------------------------


def load(buffer: SequenceReplayBuffer, source: Target) -> None:
    """Fill an empty buffer from a file; open episodes come back ended as truncated.

    :param buffer: of the model that is to go on with it; unusable if this raises
    :param source: path or binary file object
    :raises SnapshotError: naming the file and why it is refused
    """
    if isinstance(source, str | os.PathLike):
        source = _as_it_was_named(Path(source))
    with reading(source, KIND) as archive:
        if buffer.path is not None:
            raise ValueError(f"the model keeps its replay on disk, in {buffer.path}, and takes no other")
        data = _checked_data(buffer, archive)
        episodes = list(_episodes(buffer, archive))
        count = len(data["streams"])
        if count > len(episodes):
            raise ValueError("it has fewer episodes than environments with an open one")
        finished = episodes[: len(episodes) - count]
        restore(buffer, finished, episodes[len(finished) :], data)
        set_generator(buffer.rng, data["sampler"])


def _as_it_was_named(path: Path) -> Path:
    """Files had the ending ``.pkl`` until version 0.1, as SB3's have, though they never were pickles."""
    old = path.with_name(f"{path.name}.pkl")
    there = path.exists() or path.suffix or path.with_name(f"{path.name}.zip").exists()
    return old if not there and old.exists() else path


def load_some(buffer: SequenceReplayBuffer, source: Target) -> list[Episode]:
    """The episodes of one file of a run folder.

    :param buffer: that they must fit
    :param source: path
    :raises SnapshotError: naming the file and why it is refused
    """
    with reading(source, KIND) as archive:
        _checked_data(buffer, archive)
        return list(_episodes(buffer, archive))


def restore(buffer: SequenceReplayBuffer, finished: list[Episode], open_: list[Episode], numbers: dict[str, Any]) -> None:
    """Put episodes into an empty buffer as if it had lived through them.

    :param buffer: empty
    :param finished: finished episodes
    :param open_: open ones, which end here as truncated
    :param numbers: its counters
    """
    buffer.hold(finished)
    for name in ("evicted", "finished_count", "longest"):
        setattr(buffer, name, numbers[name])
    close(buffer, open_)
    buffer.evict()


def close(buffer: SequenceReplayBuffer, open_: list[Episode]) -> None:
    """Put episodes that were open at its end, as truncated.

    :param buffer: with no open ones of its own
    :param open_: in their order
    """
    for episode in open_:
        buffer.open[0] = episode
        buffer.close_streams()


def _checked_data(buffer: SequenceReplayBuffer, archive: Archive) -> dict[str, Any]:
    data = archive.data
    if set(data) != FIELDS:
        raise ValueError("it has other fields than it should")
    for name in NUMBERS:
        if type(data[name]) is not int or not 0 <= data[name] < 2**62:
            raise ValueError(f"its {name} is {str(data[name])[:80]!r}")
    streams = data["streams"]
    if not isinstance(streams, list) or len(streams) > data["n_envs"]:
        raise ValueError("its list of open episodes is damaged")
    # Another number of environments will do: open episodes are ended, so that each begins a stream of its own.
    for name in ("observation_space", "action_space"):
        space = values.decode(data[name])
        if space != getattr(buffer, name):
            raise ValueError(f"the replay buffer's {name} is {space}, the model's {getattr(buffer, name)}")
    if data["phase"] != buffer.phase:
        raise ValueError(
            f"the replay buffer was filled in the phase {str(data['phase'])[:80]!r}, the model is in {buffer.phase!r}"
        )
    buffer.check_lengths(data["batch_length"])
    return data


def _episodes(buffer: SequenceReplayBuffer, archive: Archive) -> Iterator[Episode]:
    columns = buffer.columns()
    for member in archive.rows():
        table = tensors.read_table(archive, member)
        rows = table.get("reward", ("", (0,)))[1][:1]
        count = table.get(LENGTHS, ("", (0,)))[1][:1]
        expected = {name: (tensors.DTYPES[dtype], (*rows, *shape)) for name, (dtype, shape) in columns.items()}
        tensors.compare(table, {**expected, LENGTHS: ("I64", count)})
        loaded = tensors.unpack(archive, member)
        lengths = loaded.pop(LENGTHS)
        if int(lengths.sum()) != rows[0] or bool((lengths < 1).any()):
            raise ValueError(f"the lengths of {member} are damaged")
        if bool((lengths > buffer.max_episode_rows).any()):
            raise ValueError(
                f"it has an episode of {int(lengths.max())} rows, the model's replay takes {buffer.max_episode_rows} "
                "(buffer_size, or max_episode_rows in replay_buffer_kwargs)"
            )
        for part in zip(*(loaded[name].split(lengths.tolist()) for name in columns), strict=True):
            # Copies, so that an evicted episode gives its memory back.
            yield Episode.of({name: np.array(rows.numpy()) for name, rows in zip(columns, part, strict=True)})
