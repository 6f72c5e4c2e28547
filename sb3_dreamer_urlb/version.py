"""The package's version, and how to install it."""

from pathlib import Path

__version__ = Path(__file__).with_name("version.txt").read_text().strip()


def install_in_a_clone(extra: str) -> str:
    """The command that installs the package with an extra; no package index has it, so it comes from a clone.

    :param extra: of setup.cfg, as ``"plots"``; several with commas
    """
    return f"pip install '.[{extra}]'"


def how_to_install(extra: str) -> str:
    """What an error says of a missing package, to somebody who has this one: pip knows an installed wheel by its name.

    :param extra: of setup.cfg, as ``"plots"``; several with commas
    """
    by_name = f"pip install 'sb3_dreamer_urlb[{extra}]'"
    return f"in a clone of the repository: {install_in_a_clone(extra)}; where it was installed from a wheel: {by_name}"
