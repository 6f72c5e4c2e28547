"""The configurations that the package brings, and the short names by which ``-conf`` knows them: ``lbs``, ``small/lbs``.

Each algorithm has its own: ``-conf scratch`` is another file with ``--algo drq_v2``.
"""

from __future__ import annotations

import importlib.util
from pathlib import Path

import yaml

_PACKAGE = Path(__file__).parents[1]
#: algorithms whose files lie in a folder of their own, and that folder; all others are :data:`FIRST`'s
FOLDERS = {"drq_v2": "drq_v2"}
FIRST = "dreamerv2"


def folder() -> Path:
    """``zoo_configs``: inside the installed package (setup.py puts it there), in a checkout beside it."""
    installed = _PACKAGE / "zoo_configs"
    return installed if installed.is_dir() else _PACKAGE.parent / "zoo_configs"


def names() -> list[str]:
    """All short names."""
    return sorted(path.relative_to(folder()).with_suffix("").as_posix() for path in folder().rglob("*.yml"))


def names_for(algorithm: str) -> dict[str, str]:
    """What ``-conf`` knows with an algorithm: short name → name in :func:`folder`.

    :param algorithm: as ``--algo`` knows it
    """
    own = f"{FOLDERS[algorithm]}/" if algorithm in FOLDERS else ""
    found = {name.removeprefix(own): name for name in names() if _algorithm_of(name) == algorithm}
    return found | {name: name for name in found.values()}


def _shortest(algorithm: str) -> list[str]:
    return sorted({full: short for short, full in reversed(names_for(algorithm).items())}.values())


def _algorithm_of(name: str) -> str:
    return next((algorithm for algorithm, own in FOLDERS.items() if name.startswith(f"{own}/")), FIRST)


def resolve(conf: str, algorithm: str = FIRST) -> str:
    """What ``-conf`` means.

    :param conf: a file (``.yml`` or ``.py``), a Python module, or a short name; whatever is there as a file wins
    :param algorithm: as ``--algo`` knows it
    :return: a file's path, or the module as it was
    :raises ValueError: for none of these, or another algorithm's
    """
    short = conf.removesuffix(".yml")
    known = names_for(algorithm)
    if Path(conf).is_file():
        _check_algorithm(conf, _name_in_folder(Path(conf)), algorithm)
        return conf
    if short in known:
        return str(folder() / f"{known[short]}.yml")
    if not conf.endswith((".yml", ".py")) and _is_module(conf):
        return conf
    for other in (FIRST, *FOLDERS):
        _check_algorithm(conf, names_for(other).get(short), algorithm)
    raise ValueError(
        f"-conf {conf}: no such file, Python module, or configuration of this package: {', '.join(_shortest(algorithm))}."
    )


def _name_in_folder(path: Path) -> str | None:
    """Of a file that the package brings; None for others."""
    inside = path.resolve().is_relative_to(folder().resolve())
    return path.resolve().relative_to(folder().resolve()).with_suffix("").as_posix() if inside else None


def _check_algorithm(conf: str, name: str | None, algorithm: str) -> None:
    """
    :param conf: as it was given
    :param name: of the file in :func:`folder`, if it lies there
    :param algorithm: that is to be trained
    :raises ValueError: if the file is another algorithm's
    """
    if name is not None and (its := _algorithm_of(name)) != algorithm:
        raise ValueError(f"-conf {conf} is for --algo {its}, not {algorithm}, which has {', '.join(_shortest(algorithm))}.")


def check(conf: str, env_id: str) -> None:
    """Whether a file of hyperparameters has the form of one.

    :param conf: a file, or something else, which is not looked at
    :param env_id: whose hyperparameters are wanted
    :raises ValueError: naming what stands there instead
    """
    if not conf.endswith((".yml", ".yaml")):
        return
    try:
        found = yaml.safe_load(Path(conf).read_text())
    except yaml.YAMLError as error:
        raise ValueError(f"{conf} is not YAML: {error}") from error
    if not isinstance(found, dict):
        raise ValueError(f"{conf}: expected hyperparameters by environment, got {found!r}.")
    for name in (env_id, "default"):
        if name in found and not isinstance(found[name], dict):
            raise ValueError(f"{conf}: expected hyperparameters by environment, got {found[name]!r} for {name}.")


def _is_module(name: str) -> bool:
    try:
        return importlib.util.find_spec(name) is not None
    except (ImportError, ValueError):  # its parent is none, or it is no name at all
        return False
