"""A parser of command lines that answers wrong options and commands with near ones."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

from sb3_dreamer_urlb.unknown_names import did_you_mean

#: of numpy's generators, as Stable-Baselines3 seeds them
MOST_SEED = 2**32 - 1


def at_least(least: int, most: int | None = None) -> Callable[[str], int]:
    """The type of an option that counts something, or numbers it.

    :param least: smallest value
    :param most: largest value; None for none
    """

    def integer(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = least - 1
        if value < least or (most is not None and value > most):
            end = "" if most is None else f" and at most {most}"
            raise argparse.ArgumentTypeError(f"must be an integer of at least {least}{end}, got {text!r}.")
        return value

    return integer


def a_seed(text: str) -> int:
    """The type of an option that seeds something."""
    return at_least(0, MOST_SEED)(text)


def a_path(text: str) -> Path:
    """The type of an option that is a file or folder; an empty text is a variable that was not set, not the current folder."""
    if not text.strip():
        raise argparse.ArgumentTypeError(f"must be the path of a file or folder, got {text!r}.")
    return Path(text)


def with_near_choices(message: str) -> str:
    """argparse's message about a value that is none of an option's choices, with near ones at its end; others as they are.

    :param message: of ``ArgumentParser.error``
    """
    found = re.search(r"invalid choice: (.+) \(choose from (.+)\)", message)
    if found is None:
        return message
    # Quoted until Python 3.11, in some later versions not.
    value, *choices = (text.strip("'\"") for text in (found[1], *found[2].split(", ")))
    near = did_you_mean([value], choices)
    return message.rstrip(".") + "." + near if near else message


class CommandParser(argparse.ArgumentParser):
    """argparse's, also for the commands below it. argparse says first what lacks, even where that was only misspelt."""

    _words: Sequence[str] = ()

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """As argparse's.

        :param args: the words, those of the process if None
        :param namespace: to put values into
        """
        self._words = list(sys.argv[1:] if args is None else args)
        return super().parse_known_args(self._words, namespace)

    def error(self, message: str) -> NoReturn:
        """End the process with status 2, and a near name for each word that is none.

        :param message: what is wrong
        """
        options = self._option_string_actions
        wrong = [word.partition("=")[0] for word in self._words if word.startswith("--") and word != "--"]
        # The beginning of an option is taken for it.
        wrong = [name for name in wrong if not any(option.startswith(name) for option in options)]
        near = did_you_mean(wrong, options) or did_you_mean(self._wrong_command(), self._commands())
        super().error(message.rstrip(".") + "." + near if near else with_near_choices(message))

    def _commands(self) -> list[str]:
        actions = self._get_positional_actions()
        return [str(name) for action in actions[:1] if action.choices is not None for name in action.choices]

    def _wrong_command(self) -> list[str]:
        """The first word, where it should be one of few and is not."""
        word = next((word for word in self._words if not word.startswith("-")), None)
        return [word] if word is not None and word not in self._commands() else []
