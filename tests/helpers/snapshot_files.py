"""Taking files of ours apart and putting them together again, with everything else about them in order."""

from __future__ import annotations

import hashlib
import json
import sys
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

MANIFEST = "manifest.json"
#: audit events that mean that code from somewhere ran, or could
CODE_EVENTS = (
    "pickle.find_class", "exec", "compile", "os.system", "os.exec", "os.posix_spawn", "os.fork", "subprocess.Popen",
    "ctypes.dlopen", "marshal.loads", "import", "shutil.unpack_archive",
)  # fmt: skip

_watchers: list[list[str]] = []


def _hook(event: str, arguments: tuple[object, ...]) -> None:
    if _watchers and event in CODE_EVENTS:
        for seen in _watchers:
            seen.append(f"{event} {str(arguments)[:200]}")


sys.addaudithook(_hook)  # never goes away, so there is one for all tests


@contextmanager
def code_events() -> Iterator[list[str]]:
    """The audit events of running code that occur in the block."""
    seen: list[str] = []
    _watchers.append(seen)
    try:
        yield seen
    finally:
        _watchers.remove(seen)


def members(path: Path) -> dict[str, bytes]:
    """All members of a file."""
    with zipfile.ZipFile(path) as file:
        return {name: file.read(name) for name in file.namelist()}


def write(path: Path, content: dict[str, bytes] | list[tuple[str, bytes]], honest: bool = True, **options: object) -> Path:
    """A zip of given members, with a manifest that fits them if ``honest``."""
    pairs = list(content.items()) if isinstance(content, dict) else content
    if honest:
        manifest = json.loads(dict(pairs)[MANIFEST])
        manifest["members"] = {
            name: {"size": len(data), "sha256": hashlib.sha256(data).hexdigest()} for name, data in pairs if name != MANIFEST
        }
        pairs = [(name, json.dumps(manifest).encode() if name == MANIFEST else data) for name, data in pairs]
    with zipfile.ZipFile(path, "w", **options) as file:  # type: ignore[arg-type]
        for name, data in pairs:
            file.writestr(name, data)
    return path


def change_data(path: Path, target: Path, change: Callable[[dict], object]) -> Path:
    """A copy whose JSON ``data`` was changed, with sha256 that fit."""
    content = members(path)
    data = json.loads(content["data"])
    change(data)
    return write(target, {**content, "data": json.dumps(data).encode()})


def change_header(path: Path, target: Path, change: Callable[[dict], object]) -> Path:
    """A copy whose table of tensors was changed, with sha256 that fit."""
    content = members(path)
    blob = content["tensors.safetensors"]
    length = int.from_bytes(blob[:8], "little")
    header = json.loads(blob[8 : 8 + length])
    change(header)
    text = json.dumps(header).encode()
    return write(target, {**content, "tensors.safetensors": len(text).to_bytes(8, "little") + text + blob[8 + length :]})
