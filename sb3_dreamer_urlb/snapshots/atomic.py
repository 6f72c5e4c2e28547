"""Files that are there whole or not at all: temporary file beside it, fsync, rename, fsync of the folder."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from sb3_dreamer_urlb.folders import check_folder

TEMPORARY = ".tmp"


@contextmanager
def written_atomically(path: str | os.PathLike[str]) -> Iterator[BinaryIO]:
    """Write a file that replaces ``path`` only when the block ends well.

    Whatever happens before, a full disk or kill -9 included, leaves the old file as it was. A link stays one, and what it
    leads to is replaced.

    :param path: missing folders are made
    :return: binary file to write to
    :raises NotADirectoryError: if a file is where a folder is needed, naming it
    :raises OSError: naming ``path``; for a device or a pipe, too, which nothing may replace
    """
    path = Path(os.path.realpath(path))
    check_folder("the folder of a file", path.parent)
    # The process's number keeps two writers apart; a leftover of a killed process of the same number is overwritten.
    temporary = path.parent / f".{path.name}.{os.getpid()}{TEMPORARY}"
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            raise IsADirectoryError(21, "Is a folder")
        if path.exists() and not path.is_file():
            raise OSError(22, "Is a device or a pipe, and no file that could be replaced")
        with open(temporary, "wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        sync_folder(path.parent)
    except BaseException as error:
        with suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError):
            reason = f"{error.strerror or error} (while saving; what was there before is intact)"
            raise OSError(error.errno, reason, str(path)) from error
        raise


def sync_folder(folder: Path) -> None:
    """Make the names in a folder durable."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def path_to_write(path: str | os.PathLike[str], suffix: str) -> Path:
    """As Stable-Baselines3 names files: ``suffix`` is added where there is none.

    :raises IsADirectoryError: for the current folder, or the one around it
    """
    path = Path(path)
    if path.name in ("", ".."):
        raise IsADirectoryError(f"{os.fspath(path)!r} is a folder: expected the path of a file, model.{suffix} say.")
    return path if path.suffix else Path(f"{path}.{suffix}")


def path_to_read(path: str | os.PathLike[str], suffix: str) -> Path:
    """As Stable-Baselines3 finds files: ``suffix`` is added where the path itself does not exist.

    :raises FileNotFoundError: if neither exists
    :raises IsADirectoryError: for a folder
    """
    path = Path(path)
    for candidate in (path, Path(f"{path}.{suffix}")):
        if candidate.is_file():
            return candidate
    if path.is_dir():
        raise IsADirectoryError(
            f"{path} is a folder, load() takes a file: a run folder goes on with the algorithm's resume({str(path)!r}, env), "
            "what was pushed to the Hub is read by sb3_dreamer_urlb.hub.load_from_hub."
        )
    raise FileNotFoundError(2, "No such file", str(path))
