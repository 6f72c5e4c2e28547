"""Sequences out of episodes, into one batch: on the host, on the device, or on the way between the two."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch as th

#: the pieces of one sequence, one after the other: an episode, first row, row after the last
Draw = list[tuple[Any, int, int]]
#: column of a batch that episodes do not have: where the pieces begin
IS_FIRST = "is_first"
#: columns of a batch by name, (B, T, …) each
Arrays = dict[str, np.ndarray]
Tensors = dict[str, th.Tensor]


def on_host(
    draws: Sequence[Draw], length: int, new: Callable[[str, tuple[int, ...], np.dtype], np.ndarray] | None = None
) -> Arrays:
    """Copy sequences into arrays.

    :param draws: B of them
    :param length: T, rows of each
    :param new: makes an array of a name, a shape and a dtype, for it to be filled; None for ordinary ones
    :return: (B, T, …) by name, ``IS_FIRST`` among them
    """
    columns: Arrays = {}

    def column(name: str, rows: np.ndarray) -> np.ndarray:
        if name not in columns:
            shape = (len(draws), length, *rows.shape[1:])
            columns[name] = np.empty(shape, rows.dtype) if new is None else new(name, shape, rows.dtype)
        return columns[name]

    for b, pieces in enumerate(draws):
        t = 0
        for episode, start, stop in pieces:
            for name, rows in episode.rows(start, stop).items():
                column(name, rows)[b, t : t + len(rows)] = rows
            t += stop - start
    column(IS_FIRST, np.empty(0, bool))[:] = _first_rows(draws, length)
    return columns


def _first_rows(draws: Sequence[Draw], length: int) -> np.ndarray:
    """Where the pieces of sequences begin, bool (B, T)."""
    is_first = np.zeros((len(draws), length), bool)
    for row, pieces in zip(is_first, draws, strict=True):
        t = 0
        for _, start, stop in pieces:
            row[t] = True
            t += stop - start
    return is_first


def on_device(draws: Sequence[Draw], length: int) -> Tensors:
    """Copy sequences of episodes on a device into tensors there; nothing waits, no frame crosses the bus.

    :param draws: B of them, of :class:`~sb3_dreamer_urlb.replay.device_store.DeviceEpisode`
    :param length: T, rows of each
    :return: (B, T, …) by name, ``IS_FIRST`` among them
    """
    parts = [episode.part(start, stop) for pieces in draws for episode, start, stop in pieces]
    columns = {name: th.cat([part[name] for part in parts]).unflatten(0, (len(draws), length)) for name in parts[0]}
    device = parts[0]["reward"].device
    if len(parts) > len(draws):
        columns[IS_FIRST] = th.from_numpy(_first_rows(draws, length)).to(device, non_blocking=True)
    else:
        columns[IS_FIRST] = th.zeros((len(draws), length), dtype=th.bool, device=device)
        columns[IS_FIRST][:, 0] = True
    return columns


class Transfer:
    """Brings batches from the host to where they are needed; this one: leaves them there.

    One thread at a time may use it.
    """

    def bring(self, draws: Sequence[Draw], length: int) -> Tensors:
        """Gather, and begin to copy.

        :param draws: B of them
        :param length: T, rows of each
        :return: (B, T, …) by name, for :meth:`ready` only
        """
        return {name: th.from_numpy(rows) for name, rows in on_host(draws, length).items()}

    def ready(self, columns: Tensors) -> Tensors:
        """Let the thread that calls this use what was brought last.

        :param columns: of :meth:`bring`
        :return: the same
        """
        return columns


class PinnedTransfer(Transfer):
    """Through pinned memory to a CUDA device, on a stream of its own: copies run beside an update, no thread waits for them.

    Pinned memory and stream are made with the first batch. A CUDA graph that is captured while another thread is in here
    must be captured with ``capture_error_mode="thread_local"``.

    :param device: CUDA
    """

    def __init__(self, device: th.device):
        self.device = device
        self._pinned: Tensors = {}
        self._stream: th.cuda.Stream | None = None
        self._copied: th.cuda.Event | None = None

    def bring(self, draws: Sequence[Draw], length: int) -> Tensors:
        """See :meth:`Transfer.bring`."""
        if self._stream is None or self._copied is None:
            self._stream, self._copied = th.cuda.Stream(self.device), th.cuda.Event()
        # The batch before may be on its way yet.
        self._copied.synchronize()
        on_host(draws, length, self._array)
        with th.cuda.stream(self._stream):
            columns = {name: pinned.to(self.device, non_blocking=True) for name, pinned in self._pinned.items()}
            self._copied.record(self._stream)
        return columns

    def _array(self, name: str, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
        pinned = self._pinned.get(name)
        if pinned is None or pinned.shape != shape:
            pinned = th.empty(shape, dtype=th.from_numpy(np.empty(0, dtype)).dtype, pin_memory=True)
            self._pinned[name] = pinned
        array: np.ndarray = pinned.numpy()
        return array

    def ready(self, columns: Tensors) -> Tensors:
        """See :meth:`Transfer.ready`: the current stream waits, its thread does not."""
        assert self._copied is not None
        stream = th.cuda.current_stream(self.device)
        stream.wait_event(self._copied)
        for column in columns.values():
            # They were allocated on the other stream, which must not reuse them too early.
            column.record_stream(stream)
        return columns


def make_transfer(device: th.device | None) -> Transfer:
    """What brings batches to a device.

    :param device: None for where they are
    """
    return PinnedTransfer(device) if device is not None and device.type == "cuda" else Transfer()
