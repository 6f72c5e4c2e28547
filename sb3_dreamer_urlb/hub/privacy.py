"""What leaves this machine names none of its folders."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

#: folders of absolute paths, and of those in somebody's home: /home/me/ of /home/me/logs
PRIVATE_FOLDERS = re.compile(r"(?<![\w./\\~-])(?:~|[A-Za-z]:)?[/\\](?:[^\s'\"/\\]+[/\\])+")
#: a Python that ran a module, with its options
PYTHON = re.compile(r"^.*?python[\w.]*(?: -[^m\s]\S*)*(?= -m )")


def without_private_paths(text: str) -> str:
    """For everybody to read: ``/home/me/.venv/bin/python -m`` is ``python -m``, of other absolute paths the last part stays.

    :param text: a command, or a value of an argument
    """
    return PRIVATE_FOLDERS.sub("", PYTHON.sub("python", text))


def as_plain(value: Any, text: Callable[[str], str] = str) -> Any:
    """As YAML's and JSON's own types.

    :param value: of a configuration
    :param text: for texts, and for those of anything else
    """
    if isinstance(value, dict):
        return {str(name): as_plain(part, text) for name, part in value.items()}
    if isinstance(value, list | tuple):
        return [as_plain(part, text) for part in value]
    return value if value is None or isinstance(value, bool | int | float) else text(str(value))


def plain_for_everybody(value: Any) -> Any:
    """As :func:`as_plain`, without this machine's folders.

    :param value: of a configuration
    """
    return as_plain(value, without_private_paths)
