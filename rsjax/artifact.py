"""Folders that are made once under a key: skipped if finished, resumed if half done, locked while they are made.

The key is a hash (:func:`rsjax.config.content_key`) of everything that decides the content. Use it like this::

    with make_once(out, key, refuse="holds policies of other settings; choose another --out, or delete it") as work:
        if not work.finished:
            for number in range(work.metadata.get("episodes", 0), total):  # what an earlier attempt left is still there
                write_file(out / f"{number}.clip", simulate(number))
                work.save(episodes=number + 1)  # optional: kept with the key, also if the process is killed
    return work.metadata

The body says by its end that the work is finished, and by an exception that it is half done. A result that carries its
own key, such as a store, is made from a temporary folder beside it::

    if complete_key(out) == key:
        return
    with make_once(out.with_name(f"{out.name}.partial"), key, refuse=None, wait=True, temporary=True) as work:
        if complete_key(out) != key:  # another process may have made it meanwhile
            ...  # fill work.folder, then write_store(out, ..., {"key": key})
"""

import math
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rsjax.errors import UserError
from rsjax.files import FileError, disk_guard, making, read_json, write_json

MARK = "made.json"  # in the folder


class OtherKeyError(UserError):
    """A folder holds work of another key."""


@dataclass(frozen=True)
class Mark:
    """A folder's record of its content.

    Attributes:
        key: the content key it is made under.
        finished: whether it is complete.
        seconds: time spent on it by all attempts, except those that were killed.
        metadata: what its maker saved with it, JSON-ready.
    """

    key: str
    finished: bool
    seconds: float
    metadata: dict[str, Any] = field(default_factory=dict)


@dataclass
class Work:
    """Work on a folder that this process holds.

    Attributes:
        folder: the place of the work, with everything that earlier attempts under the same key left there.
        finished: whether there is nothing left to do.
        metadata: what was saved with it; :meth:`save` adds to it.
    """

    folder: Path
    key: str
    finished: bool
    metadata: dict[str, Any]

    def save(self, **metadata: Any) -> None:
        """Adds JSON-ready values to the metadata, and writes them at once."""
        self.metadata |= metadata
        mark = read_mark(self.folder)
        seconds = mark.seconds if mark else 0.0
        _write_mark(self.folder, Mark(self.key, self.finished, seconds, self.metadata))


def read_mark(folder: Path) -> Mark | None:
    """Reads what a folder says about its content; None if it says nothing, or nothing that can be read."""
    with suppress(FileError):
        content = read_json(folder / MARK)
        seconds = content.get("seconds")
        metadata = content.get("metadata", {})
        types = type(content.get("key")), type(content.get("finished")), type(metadata)
        if types == (str, bool, dict) and type(seconds) in (int, float) and math.isfinite(seconds):
            return Mark(content["key"], content["finished"], seconds, metadata)
    return None


def is_finished(folder: Path, key: str) -> bool:
    """Returns whether a folder is complete and was made under this key."""
    mark = read_mark(folder)
    return mark is not None and mark.finished and mark.key == key


@contextmanager
def make_once(
    folder: Path,
    key: str,
    *,
    refuse: str | None,
    wait: bool = False,
    again: bool = False,
    keep: bool = False,
    temporary: bool = False,
    locked: bool = True,
) -> Iterator[Work]:
    """Holds a folder while its content is made, and marks the content as finished when the body ends.

    The body checks ``work.finished`` and does the missing work. If it raises, or its process is killed, the work counts
    as half done, and the next call with the same key finds it in place.

    Args:
        folder: created if missing. Files that this function has not marked are never deleted.
        key: the content key.
        refuse: the message, after the folder's path, for a folder that holds work of another key, with the cure. None:
            that work is deleted.
        wait: if another process works on the folder, True waits for it and False raises.
        again: do finished work again, for example because its output was deleted.
        keep: with ``refuse=None``, keep content of another key, because the body replaces each of its files.
        temporary: delete the folder when the body ends, because the result is elsewhere.
        locked: False if the caller holds a lock that covers the folder.

    Raises:
        OtherKeyError: the folder holds work of another key, and ``refuse`` has a message.
        FileError: another process works on the folder, it cannot be written, or it would have to be deleted but holds
            files of something else.
    """
    with making(folder, wait) if locked else nullcontext():
        mark = read_mark(folder)
        if mark is None or mark.key != key:
            if refuse is not None and (folder / MARK).exists():
                raise OtherKeyError(f"{folder}: {refuse}")
            if refuse is None and not keep and folder.exists():
                if not (folder / MARK).exists() and any(folder.iterdir()):
                    raise FileError(f"{folder}: holds files of something else; move them, or choose another place")
                with disk_guard(folder):
                    shutil.rmtree(folder)
            mark = Mark(key, finished=False, seconds=0.0)
        work = Work(folder, key, mark.finished and not again, dict(mark.metadata))
        if work.finished:
            yield work
            return
        began = time.monotonic()
        _write_mark(folder, Mark(key, False, mark.seconds, work.metadata))
        try:
            yield work
        except BaseException:
            if folder.exists():
                with suppress(FileError):  # on a full disk, the error that ended the work is the one to show
                    seconds = mark.seconds + time.monotonic() - began
                    _write_mark(folder, Mark(key, False, seconds, work.metadata))
            raise
        if temporary:
            shutil.rmtree(folder)
            return
        _write_mark(folder, Mark(key, True, mark.seconds + time.monotonic() - began, work.metadata))


def _write_mark(folder: Path, mark: Mark) -> None:
    content = {"key": mark.key, "finished": mark.finished, "seconds": round(mark.seconds, 1)}
    write_json(folder / MARK, content | {"metadata": mark.metadata})
