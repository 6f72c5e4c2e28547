"""The container of everything that is saved: a stored zip with JSON, safetensors and a manifest.

=============================== =======================================================================
``data``                        plain JSON: arguments, counters, spaces as tagged dictionaries
``tensors.safetensors``         weights and moments; replay files have ``rows-000000.safetensors``, ...
``manifest.json``               format, integer version, size and sha256 of each other member
``_stable_baselines3_version``  what Stable-Baselines3 and the Hub read
``system_info.txt``             of the machine that saved
=============================== =======================================================================

Checked in this order, before anything is built from it: member names and sizes, JSON, version, sha256.
"""

from __future__ import annotations

import hashlib
import io
import os
import re
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

import stable_baselines3
from stable_baselines3.common.utils import get_system_info

from sb3_dreamer_urlb.snapshots import bounded_json
from sb3_dreamer_urlb.snapshots.atomic import path_to_read, path_to_write, written_atomically
from sb3_dreamer_urlb.snapshots.migrations import VERSION, migrate

FORMAT = "sb3_dreamer_urlb"
DATA, MANIFEST, SB3_VERSION, SYSTEM_INFO = "data", "manifest.json", "_stable_baselines3_version", "system_info.txt"
TENSORS = "tensors.safetensors"
ROWS = re.compile(r"rows-\d{6}\.safetensors", re.ASCII)
#: bytes that each small member may have at most
LIMITS = {DATA: 4 << 20, MANIFEST: 4 << 20, SB3_VERSION: 64, SYSTEM_INFO: 16 << 10}
#: of the zip's table of contents
MAX_MEMBERS, MAX_DIRECTORY = 10_000, 2 << 20
BLOCK = 1 << 20
#: bytes that are kept in memory until a file object gets them
SPOOLED = 64 << 20

Target = str | os.PathLike[str] | io.IOBase | BinaryIO


class SnapshotError(ValueError):
    """A file that is no snapshot of ours, is damaged, or does not fit; names the file and the reason."""


class CallersError(Exception):
    """Not the file is wrong, but what the caller gave beside it; carries the error that says what.

    :param error: to raise instead
    """

    def __init__(self, error: Exception):
        super().__init__(str(error))
        self.error = error


class Writer:
    """Puts one archive together.

    :param file: binary, writable
    :param kind: "model", "policy" or "replay"
    """

    def __init__(self, file: BinaryIO, kind: str):
        self.kind = kind
        self._zip = zipfile.ZipFile(file, "w", zipfile.ZIP_STORED)
        self._members: dict[str, dict[str, Any]] = {}

    def __enter__(self) -> Writer:
        return self

    def __exit__(self, *_: object) -> None:
        # After a failure it would try again when it is collected, and complain.
        with suppress(OSError, ValueError):
            self._zip.close()

    def add(self, name: str, content: bytes) -> None:
        """Add a member."""
        self._members[name] = {"size": len(content), "sha256": hashlib.sha256(content).hexdigest()}
        self._zip.writestr(_info(name), content)

    def finish(self, data: dict[str, Any]) -> None:
        """Add everything else; nothing can follow."""
        self.add(DATA, bounded_json.dump(data))
        self.add(SB3_VERSION, stable_baselines3.__version__.encode())
        self.add(SYSTEM_INFO, get_system_info(print_info=False)[1].encode()[: LIMITS[SYSTEM_INFO]])
        manifest = {"format": FORMAT, "kind": self.kind, "version": VERSION, "members": self._members}
        self._zip.writestr(_info(MANIFEST), bounded_json.dump(manifest))
        self._zip.close()


def _info(name: str) -> zipfile.ZipInfo:
    # Without the time of day: equal content gives equal files.
    return zipfile.ZipInfo(name, (1980, 1, 1, 0, 0, 0))


@contextmanager
def writing(target: Target, kind: str, suffix: str = "zip") -> Iterator[Writer]:
    """Write an archive: to a path atomically, to a file object from its position on, once all is there.

    :param target: path, or binary file object
    :param kind: see :class:`Writer`
    :param suffix: added to a path that has none
    :raises FileExistsError: where a file of another kind is: all of them end in ``.zip``
    """
    if isinstance(target, str | os.PathLike):
        path = path_to_write(target, suffix) if suffix else Path(target)
        _check_no_other_kind(path, kind)
        with written_atomically(path) as file, Writer(file, kind) as writer:
            yield writer
    elif hasattr(target, "write") and not isinstance(target, io.TextIOBase):
        # A zip goes back to its members' beginnings: streams that append, compress or send cannot.
        with tempfile.SpooledTemporaryFile(SPOOLED) as spooled:
            with Writer(spooled, kind) as writer:  # type: ignore[arg-type]
                yield writer
            spooled.seek(0)
            while block := spooled.read(BLOCK):
                _write_all(target, block)
    else:
        raise TypeError(f"Expected a path or a binary file object to save to, got {_shown(target)}.")


def _write_all(target: Any, block: bytes) -> None:
    while block:
        # Raw streams may take less than they are given, and tell; others tell nothing.
        written = target.write(block)
        block = block[written:] if isinstance(written, int) else b""


def _shown(value: Any) -> str:
    return f"{type(value).__name__} {str(value)[:80]!r}"


def kind_of(path: Path) -> str | None:
    """What a safe file says that it holds; None for any other file. Nothing else of it is read or checked.

    :param path: of the file
    """
    try:
        with zipfile.ZipFile(path) as file:
            there = bounded_json.parse(file.read(MANIFEST)).get("kind")
    except (OSError, KeyError, ValueError, AttributeError, zipfile.BadZipFile):
        return None
    return there if there in ("model", "policy", "replay") else None


def _check_no_other_kind(path: Path, kind: str) -> None:
    there = kind_of(path)
    if there not in (None, kind):
        raise FileExistsError(17, f"A {kind} does not take the place of a {there}: choose another name", str(path))


class Archive:
    """An archive whose members' names and sizes, JSON, version and small members' sha256 were checked.

    :param name: what errors call it
    :param file: binary, readable, seekable
    :param kind: what it must hold
    """

    def __init__(self, name: str, file: BinaryIO, kind: str):
        self.name = name
        _check_directory(file)
        self._zip = zipfile.ZipFile(file)
        sizes = self._check_members(kind)
        manifest, data = (bounded_json.parse(self._zip.read(member)) for member in (MANIFEST, DATA))
        version = _check_manifest(manifest, kind)
        self._members: dict[str, dict[str, Any]] = manifest["members"]
        if {member: entry["size"] for member, entry in self._members.items()} != sizes:
            raise ValueError("its manifest lists other members than it has")
        for member in sizes:
            # Rows are hashed when they are read: once through a replay file is enough.
            if not ROWS.fullmatch(member):
                self._check_sha256(member)
        if not isinstance(data, dict):
            raise ValueError("its data is no JSON object")
        self.data: dict[str, Any] = migrate(kind, data, version)
        self.system_info = "".join(c for c in self._text(SYSTEM_INFO) if c.isprintable() or c == "\n")

    def rows(self) -> list[str]:
        """The names of the members with replayed rows, in order."""
        return sorted(member for member in self._members if ROWS.fullmatch(member))

    def size(self, member: str) -> int:
        """Of a member, in bytes."""
        return int(self._members[member]["size"])

    def head(self, member: str, count: int) -> bytes:
        """The first ``count`` bytes of a member."""
        with self._zip.open(member) as file:
            return file.read(count)

    def read(self, member: str) -> bytes:
        """A whole member.

        :raises ValueError: if its sha256 differs from the manifest's
        """
        content = self._zip.read(member)
        if ROWS.fullmatch(member):
            self._compare_sha256(member, hashlib.sha256(content))
        return content

    def _text(self, member: str) -> str:
        return self._zip.read(member).decode("utf-8", "replace")

    def _check_sha256(self, member: str) -> None:
        digest = hashlib.sha256()
        with self._zip.open(member) as file:
            while block := file.read(BLOCK):
                digest.update(block)
        self._compare_sha256(member, digest)

    def _compare_sha256(self, member: str, digest: Any) -> None:
        if digest.hexdigest() != self._members[member]["sha256"]:
            raise ValueError(f"the sha256 of {member} differs from the manifest's")

    def _check_members(self, kind: str) -> dict[str, int]:
        members = self._zip.infolist()
        names = [info.filename for info in members]
        if any(name.endswith((".pth", ".pkl")) for name in names):
            raise ValueError(PICKLE)
        if len(set(names)) != len(names):
            raise ValueError("it has two members of the same name")
        required = {*LIMITS, *(() if kind == "replay" else (TENSORS,))}
        unknown = [name for name in names if name not in required and not (kind == "replay" and ROWS.fullmatch(name))]
        if unknown:
            raise ValueError(f"it has a member {unknown[0][:80]!r}, which no {kind} file has")
        if required - set(names):
            raise ValueError(f"it lacks the members {sorted(required - set(names))}; is it a {kind} file?")
        for info in members:
            if info.compress_type != zipfile.ZIP_STORED or info.file_size != info.compress_size or info.flag_bits & 1:
                raise ValueError(f"its member {info.filename} is compressed or encrypted")
            if info.file_size > LIMITS.get(info.filename, 1 << 62):
                raise ValueError(f"its member {info.filename} has {info.file_size} bytes")
        return {info.filename: info.file_size for info in members if info.filename != MANIFEST}


#: what reads each kind of file
READERS = {"model": "an algorithm's load", "policy": "a policy's load", "replay": "load_replay_buffer"}
#: of every protocol since Python 3
PICKLE_BEGINS = b"\x80"
PICKLE = (
    "it is a pickle, as Stable-Baselines3 writes them, and loading it could run any code. If you trust where it comes "
    "from, convert it: sb3-dreamer-urlb convert OLD NEW --trust"
)


@contextmanager
def reading(source: Target, kind: str, suffix: str = "zip") -> Iterator[Archive]:
    """Open an archive, and turn whatever is wrong with it into one error that names it.

    :param source: path, or binary file object
    :param kind: what it must hold
    :param suffix: added to a path that does not exist
    :raises FileNotFoundError: if there is no such file
    :raises SnapshotError: for everything that its content, or what the block makes of it, does wrong
    """
    if isinstance(source, str | os.PathLike):
        path = path_to_read(source, suffix)
        with open(path, "rb") as file, blaming(str(path)):
            yield Archive(str(path), file, kind)
    elif hasattr(source, "read") and not isinstance(source, io.TextIOBase):
        stream: Any = source if source.seekable() else io.BytesIO(source.read())
        name = f"file object {getattr(source, 'name', '')}".strip()
        with blaming(name):
            yield Archive(name, stream, kind)
    else:
        raise TypeError(f"Expected a path or a binary file object to load from, got {_shown(source)}.")


@contextmanager
def blaming(name: str) -> Iterator[None]:
    """Turn what a bad file makes others raise into a :class:`SnapshotError` that names the file.

    :param name: of the file
    """
    try:
        yield
    except SnapshotError:
        raise
    except CallersError as wrong:
        raise wrong.error from wrong.error.__cause__
    # zipfile alone raises most of these for damaged files; constructors raise the rest for fields of wrong types.
    except (
        zipfile.BadZipFile, zlib.error, struct.error, ValueError, TypeError, AssertionError, LookupError, EOFError,
        ArithmeticError, RuntimeError, AttributeError, OSError,
    ) as error:  # fmt: skip
        raise SnapshotError(f"{name} is refused: {error}") from error


def _check_directory(file: BinaryIO) -> None:
    """Bound the table of contents before zipfile reads it: the end record must be the file's last 22 bytes."""
    size = file.seek(0, io.SEEK_END)
    file.seek(max(0, size - 98))
    tail = file.read(98)
    file.seek(0)
    if file.read(2)[:1] == PICKLE_BEGINS:
        raise ValueError(PICKLE)
    end = tail[-22:]
    if len(end) < 22 or end[:4] != b"PK\x05\x06" or end[20:] != b"\0\0":
        raise ValueError("it is no zip file, or was cut short")
    entries, directory = struct.unpack("<HL", end[10:16])
    if tail[-42:-38] == b"PK\x06\x07":  # 64-bit sizes
        if tail[:4] != b"PK\x06\x06":
            raise ValueError("its end record is damaged")
        entries, directory = struct.unpack("<QQ", tail[32:48])
    if entries > MAX_MEMBERS or directory > MAX_DIRECTORY:
        raise ValueError(f"it has {entries} members")


def _check_manifest(manifest: Any, kind: str) -> int:
    if not isinstance(manifest, dict) or set(manifest) != {"format", "kind", "version", "members"}:
        raise ValueError("its manifest has other fields than it should")
    if manifest["format"] != FORMAT or manifest["kind"] != kind:
        reader = READERS.get(str(manifest["kind"])) if manifest["format"] == FORMAT else None
        raise ValueError(
            f"it is a {manifest['format']} {manifest['kind']} file, not a {FORMAT} {kind} file"
            f"{f': {reader} reads it' if reader else ''}"
        )
    version, members = manifest["version"], manifest["members"]
    if type(version) is not int or version < 1:
        raise ValueError(f"its version is {version!r}")
    if version > VERSION:
        raise ValueError(f"it has format version {version}, this package reads up to {VERSION}: update sb3_dreamer_urlb")
    if not isinstance(members, dict) or not all(
        isinstance(entry, dict)
        and set(entry) == {"size", "sha256"}
        and type(entry["size"]) is int
        and isinstance(entry["sha256"], str)
        for entry in members.values()
    ):
        raise ValueError("its manifest is damaged")
    return version
