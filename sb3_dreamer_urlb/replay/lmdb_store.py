"""Finished episodes in an LMDB file: they survive the process, and need no memory (docs/reliability.md, "Replay on disk").

An episode is stored in chunks of ``CHUNK`` rows, each the raw bytes of one column after the other. Its chunks, the
removal of what it drives out and the new cursor are one transaction: after a kill at any moment the file holds whole
episodes and a cursor that tells which. Episodes that left since the last checkpoint stay in the file until the next one
(:meth:`LmdbStore.release`), so that a resumed run begins with the rows that the checkpoint knew.
"""

from __future__ import annotations

import fcntl
import gc
import json
import os
import shutil
import weakref
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

import lmdb
import numpy as np

from sb3_dreamer_urlb.folders import made_folder
from sb3_dreamer_urlb.replay.rows import NamedRows

#: rows that are read and written together
CHUNK = 25
VERSION = 1
META = b"meta"
FREE_PAGES = 16
#: what a file needs beyond the rows: pages, freed ones that readers still see
SPARE = 64 << 20
RESERVE = 1 << 20
#: rows for which the file has room beyond ``buffer_size``: those that leave between two checkpoints
HELD_ROWS = 20_000


class ReplayStoreError(RuntimeError):
    """A replay store cannot be used; the message names its folder and why."""


class StoredEpisode(NamedRows):
    """An episode in the file; reads when asked.

    :param store: that holds it
    :param number: of the episode, counted over the store's life
    :param length: rows
    """

    def __init__(self, store: LmdbStore, number: int, length: int):
        self.store, self.number, self.length = store, number, length

    def __len__(self) -> int:
        return self.length

    def rows(self, start: int, stop: int) -> dict[str, np.ndarray]:
        """Some rows of every column."""
        return self.store.read(self, start, stop)


class LmdbStore:
    """A queue of episodes on disk, for one process.

    :param path: folder of the file
    :param layout: name → (dtype, shape of a row) of each column
    :param identity: what rows of another run must agree in to be taken over, JSON
    :param map_size: bytes that the file may have; the oldest episodes go when they do not suffice
    :raises ReplayStoreError: if another process uses it, it is damaged, or holds rows of something else
    """

    def __init__(
        self, path: Path, layout: dict[str, tuple[np.dtype, tuple[int, ...]]], identity: dict[str, Any], map_size: int
    ):
        self.path, self.layout, self.map_size = path, layout, map_size
        #: number of the first episode that the last checkpoint needs; None keeps none that left
        self.keep_from: int | None = None
        #: LMDB needs room even to remove something
        self.reserve = min(map_size // 8, RESERVE)
        self.row_bytes = {name: dtype.itemsize * int(np.prod(shape)) for name, (dtype, shape) in layout.items()}
        columns = {name: [str(dtype), list(shape)] for name, (dtype, shape) in layout.items()}
        self._identity = {"version": VERSION, "chunk": CHUNK, "columns": columns, **identity}
        made_folder("replay_buffer_kwargs: path", self.path)
        self._lock = self._take_lock()
        try:
            self.env = lmdb.open(str(path), map_size=map_size - self.reserve, readahead=False, meminit=False, max_dbs=0)
        except lmdb.Error as error:
            self._lock.close()
            raise ReplayStoreError(f"{path} cannot be opened: {error}") from None
        self._closer = weakref.finalize(self, _close, self.env, self._lock)
        try:
            self._open()
        except Exception:
            self.close()
            raise

    def _take_lock(self) -> IO[str]:
        lock = open(self.path / "writer.lock", "a+")
        for last in (False, True):
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if last:
                    lock.close()
                    raise ReplayStoreError(
                        f"{self.path} is in use by another run, or by another buffer of this one: a model of this program "
                        "that nobody needs gives it back when it is deleted (del model)."
                    ) from None
                # A model that nobody holds any more may still be there: it refers to itself.
                gc.collect()
        return lock

    def _open(self) -> None:
        info = self.env.info()
        # LMDB need not have written its last few pages, if they are free.
        needed = (info["last_pgno"] + 1 - FREE_PAGES) * self.env.stat()["psize"]
        if os.path.getsize(self.path / "data.mdb") < needed:
            # Reading on would end in SIGBUS.
            raise ReplayStoreError(f"{self.path} is damaged: data.mdb is shorter than its {needed} bytes.")
        self.first, self.lengths, self.counters = 0, [], {"finished_count": 0, "longest": 0}
        #: lengths of the episodes that left, and are still in the file for the last checkpoint's sake, oldest first
        self.held: list[int] = []
        with self.env.begin() as transaction:
            stored = transaction.get(META)
        if stored is None:
            return
        try:
            meta = json.loads(bytes(stored))
            identity, first, lengths, counters = meta["identity"], meta["first"], meta["lengths"], meta["counters"]
            self.first, self.lengths = int(first), [int(length) for length in lengths]
            self.held = [int(length) for length in meta.get("held", [])]
            self.counters = {name: int(counters[name]) for name in self.counters}
            damaged = self._oldest < 0 or any(length < 1 for length in self.held + self.lengths)
        except (ValueError, KeyError, TypeError):
            damaged = True
        if damaged:
            raise ReplayStoreError(f"{self.path} is damaged: its cursor cannot be read.")
        for name, value in self._identity.items():
            if identity.get(name) != value:
                raise ReplayStoreError(
                    f"{self.path} holds rows of another run: {name} is {identity.get(name)!r}, expected {value!r}. "
                    "Choose another path, or remove the folder."
                )

    def close(self) -> None:
        """Close the file. May be called again."""
        self._closer()

    # -- the queue -----------------------------------------------------------------------------------------------------

    @property
    def _oldest(self) -> int:
        """Number of the oldest episode in the file."""
        return self.first - len(self.held)

    def __len__(self) -> int:
        return len(self.lengths)

    def __getitem__(self, index: int) -> StoredEpisode:
        index = range(len(self.lengths))[index]
        return StoredEpisode(self, self.first + index, self.lengths[index])

    def __iter__(self) -> Iterator[StoredEpisode]:
        return (self[index] for index in range(len(self)))

    def popleft(self) -> StoredEpisode:
        """Remove the oldest episode."""
        oldest = self[0]
        self.change(None, 1, self.counters)
        return oldest

    def change(self, episode: Any, leaving: int, counters: dict[str, int]) -> int:
        """Add an episode, let the oldest go and note the counters, in one transaction.

        :param episode: to add; None for none
        :param leaving: how many of the oldest go
        :param counters: to keep beside
        :return: how many more had to go
        :raises ReplayStoreError: if it does not even fit alone
        :raises OSError: if the disk is full; the file stays as it was
        """
        more = 0
        while True:
            try:
                self._write(episode, leaving, counters)
                return more
            except lmdb.MapFullError:
                # The bound counts for more than the last checkpoint's rows.
                self.keep_from = None
                leaving, gone = leaving if self.held else max(leaving, -(-len(self) // 8)), leaving
                if not len(self) and not self.held:
                    raise ReplayStoreError(
                        f"{self.path}: map_size={self.map_size} bytes are too few for one episode."
                    ) from None
                with self._removing():
                    self._write(None, leaving, self.counters)
                more, leaving = more + leaving - gone, 0
            except lmdb.Error as error:
                # LMDB calls a full disk an input/output error.
                free = shutil.disk_usage(self.path).free
                raise OSError(f"{error}, {free} bytes are free (the replay stays as it was): {self.path}") from None

    @contextmanager
    def _removing(self) -> Iterator[None]:
        """Around a transaction that removes: with the room for it, and such that what it frees can be used at once."""
        self.env.set_mapsize(self.map_size)
        try:
            yield
            # LMDB reuses pages from the second transaction after the one that freed them.
            self._write(None, 0, self.counters)
        finally:
            self.env.set_mapsize(self.map_size - self.reserve)

    def _write(self, episode: Any, leaving: int, counters: dict[str, int]) -> None:
        first = self.first + leaving
        kept_from = first if self.keep_from is None else min(self.keep_from, first)
        end = self.first + len(self.lengths)
        with self.env.begin(write=True) as transaction:
            added = [] if episode is None else [len(episode)]
            state = self._cut(transaction, kept_from, first, end, added, counters)
            for start in range(0, sum(added), CHUNK):
                rows = episode.rows(start, min(start + CHUNK, len(episode)))
                value = b"".join(np.ascontiguousarray(rows[name]).tobytes() for name in self.layout)
                transaction.put(_key(end, start), value)
        self.first, self.held, self.lengths, self.counters = state

    def _cut(
        self, transaction: Any, kept_from: int, first: int, end: int, added: list[int], counters: dict[str, int]
    ) -> tuple[int, list[int], list[int], dict[str, int]]:
        """Remove the episodes before ``kept_from`` and from ``end`` on, and write the cursor.

        :param transaction: to do it in
        :param kept_from: number of the oldest that stays in the file
        :param first: number of the oldest that is drawn
        :param end: number after the last that stays
        :param added: lengths of what the transaction adds after it
        :param counters: to keep beside
        :return: the new ``first``, ``held``, ``lengths`` and ``counters``
        """
        held: list[int] = []
        lengths: list[int] = []
        for number, length in enumerate(self.held + self.lengths, self._oldest):
            if not kept_from <= number < end:
                self._delete(transaction, number, length)
            else:
                (held if number < first else lengths).append(length)
        lengths += added
        meta = {"identity": self._identity, "first": first, "held": held, "lengths": lengths, "counters": counters}
        transaction.put(META, json.dumps(meta).encode())
        return first, held, lengths, dict(counters)

    def release(self, first: int) -> None:
        """A checkpoint is complete: what left before it may go.

        :param first: number of the oldest episode that the checkpoint draws from
        """
        self.keep_from = first
        if self._oldest < first:
            # On a full disk they go with the next change.
            with suppress(lmdb.Error), self._removing():
                self._write(None, 0, self.counters)

    def roll_back(self, end: int, first: int, counters: dict[str, int]) -> int:
        """Go back to a checkpoint: forget the episodes after it, take back those that left since.

        :param end: number of the first episode that goes
        :param first: number of the oldest one that the checkpoint drew from
        :param counters: as of the checkpoint
        :return: how many of the checkpoint's episodes are gone for good, because ``map_size`` had no room for them
        :raises ReplayStoreError: if episodes that the checkpoint names are not there
        """
        if end > self.first + len(self.lengths) or end < 0:
            raise ReplayStoreError(
                f"{self.path} lacks episodes that the checkpoint names. If the replay was moved: resume(folder, env, "
                "replay_buffer_kwargs={'path': ...})."
            )
        there = min(max(first, self._oldest), end)
        self.keep_from = there
        with self._removing():
            with self.env.begin(write=True) as transaction:
                state = self._cut(transaction, there, there, end, [], counters)
            self.first, self.held, self.lengths, self.counters = state
        return there - first

    @staticmethod
    def _delete(transaction: Any, number: int, length: int) -> None:
        for start in range(0, length, CHUNK):
            transaction.delete(_key(number, start))

    # -- rows ----------------------------------------------------------------------------------------------------------

    def read(self, episode: StoredEpisode, start: int, stop: int) -> dict[str, np.ndarray]:
        """Some rows of an episode.

        :param episode: of this store
        :param start: first row
        :param stop: after the last row
        :return: name → rows, copies
        :raises ReplayStoreError: if they are not there as they should be
        """
        found = {name: np.empty((stop - start, *shape), dtype) for name, (dtype, shape) in self.layout.items()}
        with self.env.begin(buffers=True) as transaction:
            for chunk in range(start - start % CHUNK, stop, CHUNK):
                count = min(CHUNK, len(episode) - chunk)
                value = transaction.get(_key(episode.number, chunk))
                if value is None or len(value) != count * sum(self.row_bytes.values()):
                    raise ReplayStoreError(f"{self.path} is damaged: rows {chunk} on of episode {episode.number} are missing.")
                low, high = max(start, chunk), min(stop, chunk + count)
                offset = 0
                for name, (dtype, shape) in self.layout.items():
                    size = self.row_bytes[name]
                    if size:
                        begin, end = offset + (low - chunk) * size, offset + (high - chunk) * size
                        part = np.frombuffer(value[begin:end], dtype).reshape(high - low, *shape)
                        found[name][low - start : high - start] = part
                    offset += count * size
        return found


def _key(number: int, start: int) -> bytes:
    """Sorted as written, so that pages fill up one after the other."""
    return f"{number:016x}{start:08x}".encode()


def _close(env: Any, lock: IO[str]) -> None:
    env.close()
    lock.close()
