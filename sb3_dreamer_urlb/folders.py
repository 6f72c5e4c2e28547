"""Folders and files that are written: where one has the other's name, it is named before anything else is done."""

from __future__ import annotations

import os
from pathlib import Path


def check_folder(argument: str, path: str | os.PathLike[str]) -> None:
    """Whether a path is a folder, or can become one.

    :param argument: what the path was given as, for the message
    :param path: of the folder
    :raises NotADirectoryError: naming the file that has its name, or that of a folder around it
    :raises ValueError: for what is no path
    """
    if not isinstance(path, str | os.PathLike):
        raise ValueError(f"{argument} must be the path of a folder, got {path!r}.")
    folder = Path(path)
    # os.path: what may not be looked at is for whoever writes to find out.
    file = next((part for part in (folder, *folder.parents) if os.path.exists(part) and not os.path.isdir(part)), None)
    if file is not None:
        there = "a file of that name is there" if file == folder else f"{str(file)!r} is a file"
        raise NotADirectoryError(f"{argument} must be the path of a folder, got {str(folder)!r}: {there}.")


def made_folder(argument: str, path: str | os.PathLike[str]) -> Path:
    """Make a folder, and those around it, where they are missing.

    :param argument: what the path was given as, for the message
    :param path: of the folder
    :raises NotADirectoryError: as :func:`check_folder`
    """
    check_folder(argument, path)
    Path(path).mkdir(parents=True, exist_ok=True)
    return Path(path)


def check_file(argument: str, path: str | os.PathLike[str]) -> None:
    """Whether a path is a file, or can become one: before the hours whose result it is for.

    :param argument: what the path was given as, for the message
    :param path: of the file
    :raises IsADirectoryError: naming the folder that has its name
    :raises NotADirectoryError: as :func:`check_folder`, about the folder that it is for
    """
    if os.path.isdir(path):
        raise IsADirectoryError(f"{argument} must be the path of a file, got {os.fspath(path)!r}: that is a folder.")
    check_folder(f"the folder of {argument}", Path(path).parent)
