"""Where finished episodes are kept: one interface, in memory, on the device or on disk (docs/concepts.md, "Replay").

A store is a queue of episodes, oldest first: ``popleft``, ``len``, indexing and iteration; an episode has a length and
``rows(start, stop)``, which gives arrays by name. In memory it is a deque of
:class:`~sb3_dreamer_urlb.replay.episode.Episode`, on the device one of
:class:`~sb3_dreamer_urlb.replay.device_store.DeviceEpisode`, on disk a
:class:`~sb3_dreamer_urlb.replay.lmdb_store.LmdbStore`.
"""

from __future__ import annotations

import os
import shutil
import warnings
from pathlib import Path

import torch as th

from sb3_dreamer_urlb.folders import check_folder
from sb3_dreamer_urlb.version import how_to_install

AUTO, MEMORY, DEVICE, LMDB = STORES = ("auto", "memory", "device", "lmdb")
#: of a device's free memory, what ``"auto"`` takes for the replay; the rest is for networks and updates
DEVICE_SHARE = 0.6


def check_store(store: str, path: str | os.PathLike[str] | None, map_size: int | None) -> None:
    """:raises ValueError: for arguments that do not fit
    :raises ModuleNotFoundError: if lmdb is not installed
    """
    if store not in STORES:
        raise ValueError(f"store must be one of {list(STORES)}, got {store!r}.")
    if (store == LMDB) != (path is not None):
        raise ValueError(f"store={store!r} and path={path!r}: a path is for store='lmdb', which needs one.")
    if path is not None:
        check_folder("replay_buffer_kwargs: path", path)
    if map_size is not None and (store != LMDB or map_size < 1 << 20):
        raise ValueError(f"map_size must be at least {1 << 20} bytes, and is for store='lmdb' only, got {map_size!r}.")
    if store == LMDB:
        try:
            import lmdb  # noqa: F401
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(f"store='lmdb' needs a package; {how_to_install('lmdb')} ({error})") from None


def choose(store: str, device: th.device, needed: int) -> str:
    """What ``"auto"`` stands for: the device's memory where that is another one than the host's, and large enough.

    :param store: one of ``STORES``
    :param device: of the learner
    :param needed: bytes of a full buffer
    :return: another one than ``"auto"``
    """
    if store != AUTO:
        return store
    return DEVICE if device.type == "cuda" and needed <= DEVICE_SHARE * free_memory(device) else MEMORY


def warn_if_too_large(buffer_size: int, row_bytes: int, path: Path | None, device: th.device | None = None) -> None:
    """Tell before the run starts, not after a day, that a full buffer will not fit.

    :param buffer_size: rows
    :param row_bytes: of one row
    :param path: of the store on disk, None for another one
    :param device: of the store on a device, None for another one
    """
    needed = buffer_size * row_bytes
    if device is not None:
        there, what = free_memory(device), f"free memory on the device {device}"
        remedy = "Choose a smaller buffer_size, or replay_buffer_kwargs={'store': 'auto'}."
    elif path is None:
        there, what = _memory(), "memory"
        remedy = "Choose a smaller buffer_size, or replay_buffer_kwargs={'store': 'lmdb', 'path': ...}."
    else:
        folder = next(parent for parent in (path, *path.absolute().parents) if parent.exists())
        there, what = shutil.disk_usage(folder).free, f"free space in {folder}"
        remedy = "Choose a smaller buffer_size."
    if needed > there:
        warnings.warn(
            f"buffer_size={buffer_size} rows of {row_bytes} bytes will take {needed / 1e9:.1f} GB, "
            f"but there are {there / 1e9:.1f} GB of {what}. {remedy}"
        )


def free_memory(device: th.device) -> int:
    """Bytes of a device's memory that are free, or that this process holds without need; on CPU, all that it may have."""
    if device.type != "cuda":
        return _memory()
    unused = th.cuda.memory_reserved(device) - th.cuda.memory_allocated(device)
    return int(th.cuda.mem_get_info(device)[0]) + unused


def _memory() -> int:
    """Bytes of memory that this process may have: the machine's, or its container's."""
    total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    try:
        limit = Path("/sys/fs/cgroup/memory.max").read_text().strip()
    except OSError:
        return total
    return min(total, int(limit)) if limit.isdigit() else total
