"""The configurations that the package brings, and the short names by which ``-conf`` knows them: ``lbs``, ``small/lbs``."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import yaml

_PACKAGE = Path(__file__).parents[1]


def folder() -> Path:
    """``zoo_configs``: inside the installed package (setup.py puts it there), in a checkout beside it."""
    installed = _PACKAGE / "zoo_configs"
    return installed if installed.is_dir() else _PACKAGE.parent / "zoo_configs"


def names() -> list[str]:
    """All short names."""
    return sorted(path.relative_to(folder()).with_suffix("").as_posix() for path in folder().rglob("*.yml"))


def resolve(conf: str) -> str:
    """What ``-conf`` means.

    :param conf: a file (``.yml`` or ``.py``), a Python module, or a short name; whatever is there as a file wins
    :return: a file's path, or the module as it was
    :raises ValueError: for none of these
    """
    if Path(conf).is_file():
        return conf
    shipped = folder() / f"{conf.removesuffix('.yml')}.yml"
    if conf.removesuffix(".yml") in names():
        return str(shipped)
    if not conf.endswith((".yml", ".py")) and _is_module(conf):
        return conf
    raise ValueError(f"-conf {conf}: no such file, Python module, or configuration of this package: {', '.join(names())}.")


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
