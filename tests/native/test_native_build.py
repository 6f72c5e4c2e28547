"""The kernels' library is compiled once a machine, and whatever is wrong with compiler or cache is said or mended."""

from __future__ import annotations

import os
import platform
import shlex
import subprocess
import sys
import time
from pathlib import Path

import pytest

from sb3_dreamer_urlb.native import build, ops

SOURCE = 'extern "C" __attribute__((visibility("default"))) int answer() { return 42; }\n'
LOAD = """
import sys
from pathlib import Path
from sb3_dreamer_urlb.native import build
build.FOLDER = Path(sys.argv[1])
assert build.load().answer() == 42
"""


@pytest.fixture(autouse=True)
def cache(monkeypatch, tmp_path):
    """A cache folder of the test's own, not yet there."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "sb3_dreamer_urlb"


@pytest.fixture(autouse=True)
def source(monkeypatch, tmp_path):
    """A folder with one source that compiles in no time."""
    folder = tmp_path / "sources"
    folder.mkdir()
    (folder / "answer.cpp").write_text(SOURCE)
    monkeypatch.setattr(build, "FOLDER", folder)
    return folder / "answer.cpp"


@pytest.fixture
def compiler():
    """Skips where there is none."""
    try:
        return build.find_compiler()
    except build.NativeUnavailable as error:
        pytest.skip(str(error))


@pytest.fixture
def program(monkeypatch, tmp_path):
    """Make a shell script the compiler."""

    def make(text):
        path = tmp_path / "compiler"
        path.write_text(f"#!/bin/sh\n{text}\n")
        path.chmod(0o755)
        monkeypatch.setenv("CXX", str(path))

    return make


@pytest.fixture
def never_compiles(monkeypatch):
    def refuse(*_):
        raise AssertionError("compiled")

    return lambda: monkeypatch.setattr(build, "_compile", refuse)


def test_the_second_one_finds_it(compiler, cache, never_compiles):
    assert build.load().answer() == 42
    (file,) = cache.iterdir()
    assert file.name.startswith("native-") and file.suffix == ".so" and cache.stat().st_mode & 0o777 == 0o700
    never_compiles()
    assert build.load().answer() == 42
    assert list(cache.iterdir()) == [file]


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: content[: len(content) // 2],
        lambda content: b"",
        lambda content: content[:-1] + b"?",
        lambda content: b"?" * 99,
    ],
    ids=["half", "empty", "last byte", "other"],
)
def test_a_broken_file_is_built_anew(compiler, cache, damage):
    build.load()
    (file,) = cache.iterdir()
    whole = file.read_bytes()
    # As another file: the one that is loaded must stay as it is.
    file.unlink()
    file.write_bytes(damage(whole))
    assert build.load().answer() == 42
    assert list(cache.iterdir()) == [file] and build._is_intact(file)


def test_what_the_linker_refuses_is_built_anew(compiler, cache):
    build.load()
    (file,) = cache.iterdir()
    other = cache.parent / "no library"
    other.write_bytes(b"no library")
    build._keep(other, file)
    assert build._is_intact(file)
    assert build.load().answer() == 42


def test_whatever_changes_the_code_changes_the_name(compiler, cache, source, program, monkeypatch):
    build.load()
    source.write_text(SOURCE.replace("42", "43"))
    assert build.load().answer() == 43
    (source.parent / "header.h").write_text("// new\n")
    build.load()
    monkeypatch.setattr(build, "FLAGS", (*build.FLAGS, "-DFLAG"))
    build.load()
    monkeypatch.setenv("CXX", f"{compiler[0]} -DMACRO")
    build.load()
    # A compiler that predefines something else, as on another processor.
    program(f'exec {shlex.join(compiler)} -DOTHER "$@"')
    build.load()
    monkeypatch.setenv(build.MARCH, platform.machine().replace("_", "-") if platform.machine() == "x86_64" else "armv8-a")
    build.load()
    assert len(list(cache.iterdir())) == 7


def test_processes_at_the_same_time(compiler, cache, source):
    command = [sys.executable, "-c", LOAD, str(source.parent)]
    processes = [subprocess.Popen(command, stderr=subprocess.PIPE) for _ in range(2)]
    for process in processes:
        assert process.communicate()[1] == b"" and process.returncode == 0
    (file,) = cache.iterdir()
    assert build._is_intact(file)


# -- no cache --------------------------------------------------------------------------------------------------------------


def _leaves_nothing(tmp_path, monkeypatch):
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr(build.tempfile, "tempdir", str(tmp_path / "tmp"))
    assert build.load().answer() == 42
    return list((tmp_path / "tmp").iterdir()) == []


def test_a_cache_that_cannot_be_made(compiler, monkeypatch, tmp_path):
    (tmp_path / "cache").write_text("a file where the folder should be")
    assert build.cache_folder() is None
    assert _leaves_nothing(tmp_path, monkeypatch)


def test_a_cache_that_takes_no_files(compiler, cache, monkeypatch, tmp_path):
    def refuse(*_):
        raise OSError("disk full")

    monkeypatch.setattr(build.os, "replace", refuse)
    assert _leaves_nothing(tmp_path, monkeypatch) and list(cache.iterdir()) == []


def test_a_cache_that_others_may_write_to(compiler, cache, monkeypatch, tmp_path):
    """What lies there would run in this process."""
    cache.mkdir(parents=True)
    cache.chmod(0o770)
    assert build.cache_folder() is None
    assert _leaves_nothing(tmp_path, monkeypatch) and list(cache.iterdir()) == []
    cache.chmod(0o700)
    assert build.cache_folder() == cache
    monkeypatch.setattr(build.os, "getuid", lambda: os.stat(cache).st_uid + 1)
    assert build.cache_folder() is None


def test_where_it_is(monkeypatch, tmp_path):
    monkeypatch.setenv("HOME", str(tmp_path))
    for value in ("", "relative"):
        monkeypatch.setenv("XDG_CACHE_HOME", value)
        assert build.cache_folder() == tmp_path / ".cache" / "sb3_dreamer_urlb"

    def homeless():
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", homeless)
    assert build.cache_folder() is None


# -- no library ------------------------------------------------------------------------------------------------------------


def test_no_compiler(monkeypatch, tmp_path):
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(build.NativeUnavailable, match=r"no C\+\+ compiler: none of c\+\+, g\+\+, clang\+\+ is on the PATH"):
        build.load()
    for value, words in (("icpc -O3", "'icpc -O3', and there is no such program"), ("'", "No closing quotation")):
        monkeypatch.setenv("CXX", value)
        with pytest.raises(build.NativeUnavailable, match=words):
            build.load()


def test_the_first_compiler_on_the_path(monkeypatch, tmp_path):
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    for name in ("clang++", "g++", "c++"):
        (tmp_path / name).write_text("#!/bin/sh\n")
        (tmp_path / name).chmod(0o755)
        assert build.find_compiler() == [name]
    monkeypatch.setenv("CXX", "g++ -m64")
    assert build.find_compiler() == ["g++", "-m64"]


def test_the_compilers_words(compiler, cache, source):
    source.write_text("#error of the test\n")
    with pytest.raises(build.NativeUnavailable, match=r"(?s)answer.cpp failed with exit code \d+:.*of the test"):
        build.load()
    assert list(cache.iterdir()) == []
    source.unlink()
    with pytest.raises(build.NativeUnavailable, match=r"no C\+\+ source in "):
        build.load()


@pytest.mark.parametrize("text, words", [("exit 3", "failed with exit code 3"), ("exit 0", "cannot be kept or loaded")])
def test_a_compiler_that_compiles_nothing(program, text, words):
    program(text)
    with pytest.raises(build.NativeUnavailable, match=words):
        build.load()


def test_a_program_that_cannot_run(program, tmp_path):
    program("")
    (tmp_path / "compiler").write_bytes(b"\x7fELF")
    with pytest.raises(build.NativeUnavailable, match="Exec format error"):
        build.load()


def test_a_compiler_that_hangs(program, monkeypatch, tmp_path):
    """It ends, and so does what it has started."""
    os.mkfifo(tmp_path / "alive")
    program(f"(exec > {tmp_path / 'alive'}; sleep 60) & sleep 60")
    monkeypatch.setattr(build, "TIME_LIMIT", 0.3)
    # Its other end closes when the last one that holds it has died.
    pipe = os.open(tmp_path / "alive", os.O_RDONLY | os.O_NONBLOCK)
    with pytest.raises(build.NativeUnavailable, match=r"took more than 0.3 s"):
        build.load()
    os.set_blocking(pipe, True)
    begin = time.monotonic()
    assert os.read(pipe, 1) == b""
    os.close(pipe)
    assert time.monotonic() - begin < 30


def test_a_library_that_lacks_a_function(compiler):
    with pytest.raises(build.NativeUnavailable, match="the library has no function bias_elu_float"):
        ops.bind(build.load())
