"""Where finished episodes are kept: one interface, in memory or on disk (spec/reliability "Replay").

A store is a queue of episodes, oldest first: ``popleft``, ``len``, indexing and iteration; an episode has a length and
``rows(start, stop)``, which gives arrays by name. In memory it is a deque of
:class:`~sb3_dreamer_urlb.replay.sequence_buffer.Episode`, on disk a :class:`~sb3_dreamer_urlb.replay.lmdb_store.LmdbStore`.
"""

from __future__ import annotations

import os
import shutil
import warnings
from pathlib import Path

#: known names of stores
STORES = ("memory", "lmdb")


def check_store(store: str, path: str | os.PathLike[str] | None, map_size: int | None) -> None:
    """:raises ValueError: for arguments that do not fit
    :raises ModuleNotFoundError: if lmdb is not installed
    """
    if store not in STORES:
        raise ValueError(f"store must be one of {list(STORES)}, got {store!r}.")
    if (store == "lmdb") != (path is not None):
        raise ValueError(f"store={store!r} and path={path!r}: a path is for store='lmdb', which needs one.")
    if map_size is not None and (store != "lmdb" or map_size < 1 << 20):
        raise ValueError(f"map_size must be at least {1 << 20} bytes, and is for store='lmdb' only, got {map_size!r}.")
    if store == "lmdb":
        try:
            import lmdb  # noqa: F401
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(
                f"store='lmdb' needs a package: pip install 'sb3_dreamer_urlb[lmdb]' ({error})"
            ) from None


def warn_if_too_large(buffer_size: int, row_bytes: int, path: Path | None) -> None:
    """Tell before the run starts, not after a day, that a full buffer will not fit.

    :param buffer_size: rows
    :param row_bytes: of one row
    :param path: of the store on disk, None for one in memory
    """
    needed = buffer_size * row_bytes
    if path is None:
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


def _memory() -> int:
    """Bytes of memory that this process may have: the machine's, or its container's."""
    total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    try:
        limit = Path("/sys/fs/cgroup/memory.max").read_text().strip()
    except OSError:
        return total
    return min(total, int(limit)) if limit.isdigit() else total
