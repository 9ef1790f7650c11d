"""What a checkpoint's files must be: their sizes and checksums, in a file of the checkpoint.

It is written before the checkpoint appears under its step's name, so a checkpoint without it is a damaged one.
"""

import zlib
from pathlib import Path
from typing import Any

from rsjax.data.codec import decode, encode

NAME = "manifest.msgpack"
CHUNK_BYTES = 2**22


def write_manifest(checkpoint: Path, metric: float | None) -> None:
    """Reads all of a finished checkpoint's files and writes down their checksums.

    Args:
        metric: what the checkpoint is judged by, if anything; kept with it.

    Raises:
        OSError: a file cannot be read or written.
    """
    files = {str(path.relative_to(checkpoint)): _size_and_checksum(path) for path in _files(checkpoint)}
    (checkpoint / NAME).write_bytes(encode({"metric": metric, "files": files}))


def read_metric(checkpoint: Path) -> float | None:
    """The metric that a checkpoint was written with; None where there is none, or none that can be read."""
    try:
        return _read(checkpoint)["metric"]
    except (OSError, ValueError):
        return None


def find_fault(checkpoint: Path) -> str | None:
    """What is wrong with a checkpoint's files, in a few words that name the first bad one; None where all are whole."""
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


def _files(checkpoint: Path) -> list[Path]:
    # Those in folders: at the top lie orbax's own notes, which it changes later and which no restoring reads.
    return sorted(path for path in checkpoint.glob("*/**/*") if path.is_file())


def _size_and_checksum(path: Path) -> list[int]:
    size = checksum = 0
    with path.open("rb") as file:
        while chunk := file.read(CHUNK_BYTES):
            size, checksum = size + len(chunk), zlib.crc32(chunk, checksum)
    return [size, checksum]


def _read(checkpoint: Path) -> dict[str, Any]:
    return decode((checkpoint / NAME).read_bytes())
