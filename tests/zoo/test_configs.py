"""Configurations have short names from any folder, in a checkout and where only the wheel is installed."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import zipfile

import pytest
from places import ROOT

from sb3_dreamer_urlb.zoo import configs
from sb3_dreamer_urlb.zoo.algorithms import ALGORITHMS


@pytest.mark.parametrize("name", ["lbs", "lbs.yml", "small/lbs", "small/lbs.yml", "vectors"])
def test_short_names_from_any_folder(monkeypatch, tmp_path, name):
    monkeypatch.chdir(tmp_path)
    assert configs.resolve(name) == str(ROOT / "zoo_configs" / f"{name.removesuffix('.yml')}.yml")


def test_a_file_wins_and_modules_stay(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lbs.yml").touch()
    assert configs.resolve("lbs.yml") == "lbs.yml"
    assert configs.resolve("json.decoder") == "json.decoder"


@pytest.mark.parametrize("name", ["scratch", "small/scratch.yml", "disagreement", "drq_v2/scratch", "drq_v2/small/scratch"])
def test_short_names_are_those_of_the_algorithm(monkeypatch, tmp_path, name):
    monkeypatch.chdir(tmp_path)
    file = f"{name.removeprefix('drq_v2/').removesuffix('.yml')}.yml"
    assert configs.resolve(name, "drq_v2") == str(ROOT / "zoo_configs" / "drq_v2" / file)


@pytest.mark.parametrize(
    ("name", "algorithm", "other"),
    [
        ("lbs", "drq_v2", "dreamerv2"),
        ("small/lbs", "drq_v2", "dreamerv2"),
        (str(ROOT / "zoo_configs" / "scratch.yml"), "drq_v2", "dreamerv2"),
        ("disagreement", "dreamerv2", "drq_v2"),
        ("drq_v2/scratch", "dreamerv2", "drq_v2"),
        (str(ROOT / "zoo_configs" / "drq_v2" / "small" / "scratch.yml"), "dreamerv2", "drq_v2"),
    ],
)
def test_a_file_of_another_algorithm_is_refused(name, algorithm, other):
    with pytest.raises(ValueError, match=f"-conf .* is for --algo {other}, not {algorithm}, which has .*scratch, "):
        configs.resolve(name, algorithm)


def test_every_file_is_some_algorithms_and_no_two_s():
    found = [name for algorithm in ALGORITHMS for name in set(configs.names_for(algorithm).values())]
    assert sorted(found) == configs.names()


@pytest.mark.parametrize("name", ["lsb", "small/lsb.yml", "no/such.yml", "nowhere.py", "no.module", "../lbs", ""])
def test_anything_else_names_what_there_is(name):
    with pytest.raises(ValueError, match=r"-conf .*: no such file.*aps, .*lbs, .*small/lbs"):
        configs.resolve(name)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """What pip would install, unpacked: built from a copy without network."""
    source, out = tmp_path_factory.mktemp("source") / "checkout", tmp_path_factory.mktemp("wheel")
    kept = shutil.ignore_patterns("__pycache__", "*.egg-info", "build")
    shutil.copytree(ROOT / "sb3_dreamer_urlb", source / "sb3_dreamer_urlb", ignore=kept)
    shutil.copytree(ROOT / "zoo_configs", source / "zoo_configs")
    for name in ("setup.py", "setup.cfg", "pyproject.toml", "MANIFEST.in", "README.md", "LICENSE"):
        shutil.copyfile(ROOT / name, source / name)
    build = "from setuptools import build_meta; import sys; build_meta.build_wheel(sys.argv[1])"
    subprocess.run([sys.executable, "-c", build, str(out)], cwd=source, check=True, capture_output=True)
    (file,) = out.glob("*.whl")
    with zipfile.ZipFile(file) as archive:
        archive.extractall(out / "site")
    return out / "site"


def test_the_wheel_brings_all_that_the_package_reads(wheel):
    for folder, patterns in (("sb3_dreamer_urlb", ["*.py", "*.cpp", "*.h", "*.txt", "py.typed"]), ("zoo_configs", ["*.yml"])):
        here = {path.relative_to(ROOT).as_posix() for pattern in patterns for path in (ROOT / folder).rglob(pattern)}
        inside = "" if folder == "sb3_dreamer_urlb" else "sb3_dreamer_urlb/"
        missing = [name for name in sorted(here) if not (wheel / f"{inside}{name}").is_file()]
        assert here and not missing


def test_its_configurations_are_found_from_any_folder(wheel, tmp_path):
    code = "from sb3_dreamer_urlb.zoo import configs; print(configs.resolve('small/lbs'), *configs.names())"
    environment = {**os.environ, "PYTHONPATH": str(wheel)}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, cwd=tmp_path, check=True, capture_output=True, text=True
    )
    path, *names = done.stdout.split()
    assert path == str(wheel / "sb3_dreamer_urlb" / "zoo_configs" / "small" / "lbs.yml")
    assert names == configs.names()
