"""The library of this folder's kernels: compiled on the machine that runs it, kept in a cache folder, loaded.

A cached file is named after all that decides what is in it: sources, flags, and what the compiler predefines for this
processor. So machines that share a home folder do not meet in one file. Each ends with its own checksum, because the dynamic
linker crashes on a truncated file where one would like an error.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import os
import shlex
import shutil
import signal
import subprocess
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

# Before any CDLL: torch's wheel brings its own OpenMP, and the library shall use that one's threads.
import torch  # noqa: F401

FOLDER = Path(__file__).parent
COMPILERS = ("c++", "g++", "clang++")
# No -ffast-math: what is not a number must stay so.
FLAGS = ("-O3", "-fopenmp", "-fPIC", "-fvisibility=hidden", "-std=c++17")
#: environment variable: the processor to compile for, as the compiler's -march has it; this one's if it is not set
MARCH = "SB3_DREAMER_URLB_MARCH"
#: seconds that the compiler may take
TIME_LIMIT = 120.0


class NativeUnavailable(RuntimeError):
    """There are no kernels of our own here; the message says why."""


def load() -> ctypes.CDLL:
    """The library, from the cache or compiled now.

    :raises NativeUnavailable: where it cannot be had
    """
    compiler = find_compiler()
    try:
        cached = _cached_file(f"native-{_fingerprint(compiler)}.so")
        if cached is not None and _is_intact(cached):
            with contextlib.suppress(OSError):
                return ctypes.CDLL(str(cached))
        with tempfile.TemporaryDirectory(prefix="sb3_dreamer_urlb-") as private:
            built = Path(private) / "native.so"
            _compile(compiler, built)
            if cached is not None:
                with contextlib.suppress(OSError):
                    _keep(built, cached)
                    return ctypes.CDLL(str(cached))
            return ctypes.CDLL(str(built))
    except OSError as error:
        raise NativeUnavailable(f"the kernels' library cannot be kept or loaded: {error}") from error


def find_compiler() -> list[str]:
    """$CXX with its arguments if it is set, else the first one of ``COMPILERS`` that there is.

    :raises NativeUnavailable: where there is none
    """
    try:
        chosen = shlex.split(os.environ.get("CXX", ""))
    except ValueError as error:
        raise NativeUnavailable(f"no C++ compiler: CXX is {os.environ['CXX']!r}: {error}") from error
    if chosen:
        if shutil.which(chosen[0]) is None:
            raise NativeUnavailable(f"no C++ compiler: CXX is {os.environ['CXX']!r}, and there is no such program")
        return chosen
    for name in COMPILERS:
        if shutil.which(name) is not None:
            return [name]
    raise NativeUnavailable(f"no C++ compiler: none of {', '.join(COMPILERS)} is on the PATH")


def cache_folder() -> Path | None:
    """Where libraries are kept; None where there is no folder that this user alone writes to."""
    root = os.environ.get("XDG_CACHE_HOME", "")
    try:
        folder = (Path(root) if os.path.isabs(root) else Path.home() / ".cache") / "sb3_dreamer_urlb"
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        status = folder.stat()
    except (OSError, RuntimeError):  # RuntimeError: there is no home
        return None
    # Whoever writes there decides what this process runs.
    return folder if status.st_uid == os.getuid() and not status.st_mode & 0o022 else None


def _march() -> str:
    return f"-march={os.environ.get(MARCH) or 'native'}"


def _cached_file(name: str) -> Path | None:
    folder = cache_folder()
    return None if folder is None else folder / name


def _fingerprint(compiler: list[str]) -> str:
    macros = _run([*compiler, _march(), "-dM", "-E", "-x", "c++", os.devnull])
    digest = hashlib.sha256(repr((FLAGS, compiler[1:], _march())).encode() + macros)
    for path in sorted([*FOLDER.glob("*.cpp"), *FOLDER.glob("*.h")]):
        source = path.read_bytes()
        digest.update(f"{path.name} {len(source)}\n".encode() + source)
    return digest.hexdigest()[:20]


def _compile(compiler: list[str], file: Path) -> None:
    """Each source for itself, all at the same time, into the folder of the library."""
    sources = sorted(FOLDER.glob("*.cpp"))
    if not sources:
        raise NativeUnavailable(f"no C++ source in {FOLDER}")
    objects = [str(file.with_name(f"{source.stem}.o")) for source in sources]
    flags = (*FLAGS, _march())
    commands = [[*compiler, *flags, "-c", "-o", *pair] for pair in zip(objects, map(str, sources), strict=True)]
    with ThreadPoolExecutor() as pool:
        list(pool.map(_run, commands))
    _run([*compiler, *flags, "-shared", "-o", str(file), *objects])


def _run(command: list[str]) -> bytes:
    """What a compiler writes to its standard output."""
    with subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, "LC_ALL": "C"},
        start_new_session=True,
    ) as process:
        try:
            output, errors = process.communicate(timeout=TIME_LIMIT)
        except BaseException as error:
            # With the programs that the compiler has started, which hold its pipes.
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            if isinstance(error, subprocess.TimeoutExpired):
                raise NativeUnavailable(f"{shlex.join(command)} took more than {TIME_LIMIT:g} s") from error
            raise
    if process.returncode != 0:
        words = errors.decode(errors="replace").strip()[-1000:] or "it said nothing"
        raise NativeUnavailable(f"{shlex.join(command)} failed with exit code {process.returncode}:\n{words}")
    return output


def _keep(file: Path, cached: Path) -> None:
    """A copy with its checksum behind it, which loaders skip; whoever reads it meanwhile sees all of it or none."""
    content = file.read_bytes()
    handle, temporary = tempfile.mkstemp(dir=cached.parent, prefix=f".{cached.name}-")
    try:
        with os.fdopen(handle, "wb") as out:
            out.write(content + hashlib.sha256(content).digest())
        os.replace(temporary, cached)
    except BaseException:
        os.unlink(temporary)
        raise


def _is_intact(cached: Path) -> bool:
    try:
        content = cached.read_bytes()
    except OSError:
        return False
    size = hashlib.sha256().digest_size
    return hashlib.sha256(content[:-size]).digest() == content[-size:]
