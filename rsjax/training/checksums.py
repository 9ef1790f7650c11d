"""Sizes and checksums of a checkpoint's files, kept in a file of the checkpoint.

This file is written before the checkpoint gets its step's name, so a checkpoint without it is damaged.
"""

import json
import zlib
from pathlib import Path
from typing import Any

from rsjax.data.codec import decode
from rsjax.files import parse_json

NAME = "checksums.json"
OLD_NAME = "manifest.msgpack"  # in checkpoints of earlier versions
CHUNK_BYTES = 2**22


def write_checksums(checkpoint: Path, metric: float | None) -> None:
    """Reads all files of a finished checkpoint and writes their sizes and checksums, and the checkpoint's metric.

    Raises:
        OSError: a file cannot be read or written.
    """
    # Only files in folders: at the top are orbax's own notes, which it changes later and which no restore reads.
    paths = sorted(path for path in checkpoint.glob("*/**/*") if path.is_file())
    files = {str(path.relative_to(checkpoint)): _size_and_checksum(path) for path in paths}
    content = {"metric": metric, "files": files}
    (checkpoint / NAME).write_text(json.dumps(content | {"crc32": _checksum(content)}))


def read_metric(checkpoint: Path) -> float | None:
    """Returns the metric that a checkpoint was written with; None if it has none, or none that can be read."""
    try:
        return _read(checkpoint)["metric"]
    except (OSError, ValueError):
        return None


def find_fault(checkpoint: Path) -> str | None:
    """Returns a few words that name a checkpoint's first bad file and its fault, or None if all files are intact."""
    name = NAME
    try:
        for name, written in _read(checkpoint)["files"].items():
            if _size_and_checksum(checkpoint / name) != written:
                return f"{name}: not what was written"
    except OSError as error:
        return f"{name}: {error.strerror}"
    except ValueError:
        return f"{name}: not what was written"
    return None


def _size_and_checksum(path: Path) -> list[int]:
    size = checksum = 0
    with path.open("rb") as file:
        while chunk := file.read(CHUNK_BYTES):
            size, checksum = size + len(chunk), zlib.crc32(chunk, checksum)
    return [size, checksum]


def _checksum(content: dict[str, Any]) -> int:
    return zlib.crc32(json.dumps(content).encode())


def _read(checkpoint: Path) -> dict[str, Any]:
    """Reads the metric and the files' sizes and checksums.

    Raises:
        OSError: there is no such file.
        ValueError: the file is damaged.
    """
    path, old = checkpoint / NAME, checkpoint / OLD_NAME
    if old.exists() and not path.exists():
        return decode(old.read_bytes())
    content = parse_json(path.read_bytes())
    if content.pop("crc32", None) != _checksum(content):
        raise ValueError(f"{path}: its checksum is wrong")
    return content
