"""The package's version, and how to install it."""

from pathlib import Path

__version__ = Path(__file__).with_name("version.txt").read_text().strip()


def how_to_install(extra: str) -> str:
    """The one line that installs the package with an extra; no package index has it, so it comes from a clone.

    :param extra: of setup.cfg, as ``"plots"``; several with commas
    """
    return f"in a clone of the repository: pip install '.[{extra}]'"
