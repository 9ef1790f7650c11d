"""Files that other processes and later runs read: written atomically, locked, with clear errors on a full disk."""

import errno
import hashlib
import json
import os
import re
import shutil
import socket
import stat
import tempfile
import time
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

from filelock import lock_descriptor

from rsjax.errors import UserError, storage_limit
from rsjax.progress import note

_HEAD = 512  # bytes at a file's start by which placeholders are recognised
SEAL = "crc32"  # the field of a sealed JSON object that has its checksum
DIGEST = "sha256"  # the entry of a sealed file of tensors' metadata that has its digest
LONGEST_PATH = 4095  # bytes, on Linux
LONGEST_NAME = 255
LOCK_SECONDS = 0.25  # for this long a free lock may look taken, while other processes check it


class FileError(UserError):
    """A file cannot be read or written. The message names it and the cure."""


def parse_json(text: str | bytes, kind: type = dict) -> Any:
    """Parses JSON that came from a file.

    Raises:
        ValueError: it is not JSON in UTF-8, is nested too deeply, or is of another type than ``kind``.
    """
    try:
        content = json.loads(text if isinstance(text, str) else text.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"not JSON ({error})") from error
    if not isinstance(content, kind):
        raise ValueError(f"a JSON {kind.__name__} is expected, not {content!r:.80}")
    return content


def read_json(path: Path, kind: type = dict, cure: str = "restore it, or delete it") -> Any:
    """Reads a JSON file.

    Args:
        kind: the type of its top level, ``dict`` or ``list``.
        cure: what to do about a file that is missing or damaged.

    Raises:
        FileError: the file is missing, cannot be read, is not JSON in UTF-8, holds another type, or is sealed
            (:func:`write_json`) and was changed.
    """
    try:
        content = parse_json(regular(path).read_bytes(), kind)
        if kind is dict and type(content.get(SEAL)) is int and content.pop(SEAL) != _seal(content):
            raise ValueError("its checksum is wrong")
        return content
    except (FileNotFoundError, NotADirectoryError) as error:
        raise FileError(f"{path}: missing; {cure}") from error
    except OSError as error:
        raise FileError(f"{path}: cannot be read ({error.strerror}); mend the link or permission") from error
    except ValueError as error:
        raise FileError(f"{path}: {placeholder(path) or f'{error}; {cure}'}") from error


def checked_path(path: object, what: str) -> Path:
    """Returns a path that a caller of the public interface gave.

    Args:
        what: the argument, for error messages.

    Raises:
        FileError: it is not a path, is empty, or has characters or a length that no file name has.
    """
    if not isinstance(path, str | os.PathLike):
        raise FileError(f"{what} is {path!r:.80}; give a path, such as 'runs/tiny'")
    try:
        text = os.fspath(path)
        coded = os.fsencode(text)
    except UnicodeError as error:
        raise FileError(f"{what} is {path!r:.80}; it has characters that no file name has") from error
    if not coded or b"\0" in coded or len(coded) > LONGEST_PATH or max(map(len, coded.split(b"/"))) > LONGEST_NAME:
        raise FileError(
            f"{what} is {path!r:.80}; a path has up to {LONGEST_PATH} bytes, none of them zero, and a name in it up to "
            f"{LONGEST_NAME}"
        )
    return Path(os.fsdecode(coded))


def check_place(path: Path, what: str, directory: bool) -> None:
    """Checks, before hours of work, that something can be written at a path that a user named.

    Args:
        what: the option, for error messages.
        directory: whether it will be a directory, and not a file.

    Raises:
        FileError: it is not a path, something of another kind is there, or nothing can be written there.
    """
    path = checked_path(path, what).absolute()
    try:
        if path.exists() and (not path.is_dir() if directory else not path.is_file()):
            raise FileError(f"{what} is {path}: no {'directory' if directory else 'file'}; choose another path")
        place = next(each for each in (path, *path.parents) if each.is_dir() or os.path.lexists(each))
        if not place.is_dir() and place != path:
            raise FileError(f"{what} is {path}: {place} is not a directory; choose another path")
        if directory or place != path:
            with tempfile.TemporaryFile(dir=place):
                pass
    except OSError as error:
        raise FileError(f"{what} is {path}: nothing can be written there ({error.strerror}); choose another") from error


def regular(path: Path) -> Path:
    """Returns the same path, but refuses pipes and devices: opening or reading one may never end.

    Raises:
        OSError: it is a pipe or a device, or cannot be looked at.
    """
    mode = path.stat().st_mode
    if stat.S_ISFIFO(mode) or stat.S_ISCHR(mode) or stat.S_ISBLK(mode):
        raise OSError(errno.EINVAL, "a pipe or device, not a file", str(path))
    return path


def read_json_lines(path: Path, field: str, kind: type, cure: str = "delete the line") -> list[dict[str, Any]]:
    """Reads a file of JSON objects, one a line. Returns [] if there is none.

    A last line that is torn, as by a process that was killed while it wrote, is left out.

    Args:
        field: one that every object has, of type ``kind``.
        cure: what to do about a line that is damaged.

    Raises:
        FileError: the file cannot be read, or a line is not such an object.
    """
    try:
        lines = regular(path).read_bytes().split(b"\n") if path.exists() else []
    except OSError as error:
        raise FileError(f"{path}: cannot be read ({error.strerror}); mend the link or permission") from error
    rows: list[dict[str, Any]] = []
    for number, line in enumerate(lines, 1):
        if not line.strip():
            continue
        try:
            row = parse_json(line)
            if type(row.get(field)) is not kind:
                raise ValueError(f"{field} is {row.get(field)!r:.80}")
            rows.append(row)
        except ValueError as error:
            if number < len(lines):
                raise FileError(f"{path}: line {number} is damaged ({error}); {cure}") from error
    return rows


def content_hash(path: Path, pattern: str = "*") -> str:
    """Returns a hash of a file's content, or of a folder's files and their names, as 16 hex digits.

    Args:
        pattern: which of a folder's files are hashed; hidden files never are.

    Raises:
        FileError: a file cannot be read.
    """

    def hashed(file: Path) -> str:
        return _file_hash(file, file_versions(file))

    try:
        if not path.is_dir():
            return hashed(path)[:16]
        files = {str(file.relative_to(path)): file for file in path.rglob(pattern) if file.is_file()}
        shown = {name: hashed(file) for name, file in sorted(files.items()) if "/." not in f"/{name}"}
        return hashlib.sha256(json.dumps(shown).encode()).hexdigest()[:16]
    except OSError as error:
        raise FileError(f"{error.filename}: cannot be read ({error.strerror}); mend the path or permission") from error


@lru_cache  # hashing large files takes seconds
def _file_hash(path: Path, versions: tuple[tuple[int, ...], ...]) -> str:
    with regular(path).open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


def file_versions(path: Path) -> tuple[tuple[int, ...], ...]:
    """Returns size, time and inode of a file, or of each file of a folder; nothing of what cannot be looked at.

    In the key of a cache they make it read a replaced file again.
    """
    files = [path]
    if path.is_dir():
        files = sorted(path.rglob("*"))
    versions = []
    for file in files:
        with suppress(OSError):
            status = file.stat()
            versions.append((status.st_size, status.st_mtime_ns, status.st_ino))
    return tuple(versions)


def placeholder(content: Path | bytes) -> str:
    """Says what stands in place of a data file, such as a Git-LFS pointer, and the cure; "" if nothing known does.

    Args:
        content: the file, or its content. For a file that cannot be read, "" is returned.
    """
    if isinstance(content, Path):
        try:
            with regular(content).open("rb") as file:
                content = file.read(_HEAD)
        except OSError:
            return ""
    head = content[:_HEAD].removeprefix(b"\xef\xbb\xbf").lstrip().lower()
    if head.startswith(b"version https://git-lfs"):
        return "a Git-LFS pointer in place of the file: fetch it with git lfs pull"
    if head.startswith((b"/annex/objects/", b"../.git/annex", b".git/annex")):
        return "a git-annex pointer in place of the file: fetch it with git annex get"
    if head.startswith((b"<!doctype html", b"<html")) or (head.startswith(b"<?xml") and b"<error>" in head):
        return "a web page in place of the file: open its link in a browser and download the file itself"
    return ""


def safe_id(text: str) -> str:
    """Returns a file name for any text: the text itself if valid, otherwise its valid characters and a hash."""
    kept = re.sub(r"[^A-Za-z0-9._-]+", "-", text).lstrip(".-")[:100]
    digest = hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()[:8]
    return kept if kept and kept == text else f"{kept or 'episode'}-{digest}"


def replace_directory(new: Path, path: Path) -> None:
    """Moves a finished directory to its place and deletes an older one there afterwards."""
    old = path.with_name(f"{path.name}.old")
    shutil.rmtree(old, ignore_errors=True)
    if path.exists():
        os.replace(path, old)
    os.replace(new, path)
    shutil.rmtree(old, ignore_errors=True)


def write_atomically(path: Path, payload: bytes) -> None:
    """Writes a file that a reader sees whole or not at all."""
    temporary = path.with_name(f"{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_bytes(payload)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def write_file(path: Path, payload: bytes) -> None:
    """Writes a file atomically, with its parent directories.

    Raises:
        FileError: the disk is full, or the directory is not writable.
    """
    with disk_guard(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, payload)


def write_json(path: Path, content: Any, sealed: bool = False) -> None:
    """Writes a JSON file as :func:`write_file` does.

    Args:
        sealed: whether to add a checksum to the object, which :func:`read_json` compares: for numbers that nobody is
            to edit, where a flipped bit could give another number.
    """
    if sealed:
        content = {**content, SEAL: _seal(content)}
    write_file(path, json.dumps(content, indent=1).encode())


def _seal(content: dict[str, Any]) -> int:
    return zlib.crc32(json.dumps(content).encode())


def sealed_metadata(tensors: Mapping[str, Any], metadata: Mapping[str, str]) -> dict[str, str]:
    """Returns the metadata of a file of tensors with a digest of both, which :func:`is_intact` compares."""
    return {**metadata, DIGEST: _digest(tensors, metadata)}


def is_intact(tensors: Mapping[str, Any], metadata: Mapping[str, str]) -> bool:
    """Returns whether a file of tensors has the content that it was written with, or has no digest, as older ones."""
    content = {name: text for name, text in metadata.items() if name != DIGEST}
    return DIGEST not in metadata or metadata[DIGEST] == _digest(tensors, content)


def _digest(tensors: Mapping[str, Any], metadata: Mapping[str, str]) -> str:
    digest = hashlib.sha256(json.dumps(sorted(metadata.items())).encode())
    for name, x in sorted(tensors.items()):
        digest.update(f"{name} {x.dtype} {x.shape}".encode())
        digest.update(x.tobytes())
    return digest.hexdigest()


@contextmanager
def disk_guard(path: Path) -> Iterator[None]:
    """Turns a full disk or a refused write into a :class:`FileError` that names ``path``."""
    try:
        yield
    except (OSError, RuntimeError, ValueError) as error:  # ArrayRecord reports a full disk by the latter two
        if limit := storage_limit(error):
            raise FileError(f"{path}: {limit}") from error
        if isinstance(error, OSError):
            raise FileError(f"{path}: cannot write ({error}); check the place and its permissions") from error
        raise


@contextmanager
def lock(path: Path, wait: str = "", required: bool = True) -> Iterator[bool]:
    """Takes the lock of this name and yields True, or yields False if another process holds it (:func:`holder`).

    The operating system releases the lock of a process that dies. The file stays: deleting it would let two processes
    take locks of one name.

    Args:
        wait: a message to print, with the holder, before waiting for another process. Empty: do not wait.
        required: if False, goes on without a lock, with a message, where the file system has no locks.

    Raises:
        FileError: the file system has no locks, or the file cannot be made.
    """
    with disk_guard(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        try:
            taken = _take(handle, path)
        except FileError:
            if required:
                raise
            note(f"{path.parent}: this file system has no locks, so nothing keeps a second process from writing here")
            taken = True
        if not taken and wait:
            note(f"{wait} ({holder(path)})")
            taken = _take(handle, path, float("inf"))
        if taken:
            os.ftruncate(handle, 0)
            os.write(handle, f"process {os.getpid()} on {socket.gethostname()}".encode())
        yield taken
    finally:
        os.close(handle)


def holder(path: Path) -> str:
    """Returns who holds the lock of this name, such as ``process 4711 on node3``."""
    with suppress(OSError):
        return path.read_text("utf-8", errors="replace") or "another process"
    return "another process"


@contextmanager
def making(path: Path, wait: bool) -> Iterator[None]:
    """Keeps other processes from making the data set at ``path`` at the same time; readers are not locked out.

    Args:
        wait: if another process is making it, True waits for that process and False raises.

    Raises:
        FileError: another process is making it.
    """
    message = f"waiting for another process that makes {path}" if wait else ""
    with lock(lock_file(path), wait=message, required=False) as free:
        if not free:
            raise FileError(f"{path}: {holder(lock_file(path))} is making it; wait for that one or stop it")
        yield


def lock_file(path: Path) -> Path:
    """Returns the path of the lock that :func:`making` takes."""
    path = path.absolute()  # "." has no name of its own
    return path.with_name(f".{path.name}.lock")


def is_held(path: Path) -> bool:
    """Returns whether another process holds the lock of this name; makes no file."""
    if not path.exists():
        return False
    # NFS locks only files that are open for writing.
    handle = os.open(path, os.O_RDWR if os.access(path, os.W_OK) else os.O_RDONLY)
    try:
        return not _take(handle, path)
    except FileError:  # without locks nobody holds one
        return False
    finally:
        os.close(handle)


def _take(handle: int, path: Path, seconds: float = LOCK_SECONDS) -> bool:
    deadline = time.monotonic() + seconds
    try:
        while not (taken := lock_descriptor(handle, blocking=False)) and time.monotonic() < deadline:
            time.sleep(0.05)
    except OSError as error:
        raise FileError(
            f"{path}: this file system has no locks ({error.strerror}); choose a place on another"
        ) from error
    return taken
