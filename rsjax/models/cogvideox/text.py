"""Reads and writes files of text embeddings, and finds the text of each clip.

A file of ``rsjax convert text`` has a tensor ``embeddings``, (texts, tokens, width). Its metadata lists
the texts in the same order, the first of which is empty, and has a digest of both. Learned tokens are numbered in the
same way.
"""

import json
from collections.abc import Iterable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import safetensors
import safetensors.numpy
from jaxtyping import Float32

from rsjax.clip import UNKNOWN
from rsjax.data.store import Store
from rsjax.errors import UserError, first_line
from rsjax.files import file_versions, is_intact, sealed_metadata
from rsjax.models.cogvideox.config import TextConfig
from rsjax.progress import note

EMBEDDINGS = "embeddings"
TEXTS = "texts"
EMPTY = ""
CURE = "make it with rsjax convert text, and name it with --model.text.file"


class Texts(NamedTuple):
    """The texts of a file and their embeddings."""

    names: tuple[str, ...]
    embeddings: Float32[np.ndarray, "texts n w"]


def read_texts(file: str, tokens: int, width: int) -> Texts:
    """Reads a file of embeddings.

    Raises:
        UserError: the file is missing, damaged, no file of embeddings, or of another shape.
    """
    path = Path(file)
    if not path.is_file():
        raise UserError(f"{path}: no such file of text embeddings; {CURE}")
    return _read_texts(path, tokens, width, file_versions(path))


@lru_cache(maxsize=1)
def _read_texts(path: Path, tokens: int, width: int, versions: tuple[tuple[int, ...], ...]) -> Texts:
    try:
        with safetensors.safe_open(path, "np") as opened:
            metadata = opened.metadata() or {}
            names = json.loads(metadata.get(TEXTS, "[]"))
            made = None
            if EMBEDDINGS in opened.keys():  # noqa: SIM118 - it is not a dict
                stored = opened.get_tensor(EMBEDDINGS)
                if not is_intact({EMBEDDINGS: stored}, metadata):
                    raise ValueError("its digest is wrong")
                made = stored.astype(np.float32)
    except (safetensors.SafetensorError, OSError, ValueError, AttributeError) as error:  # the last: a type of 8 bits
        raise UserError(f"{path}: not a file of text embeddings, or damaged ({first_line(error)}); {CURE}") from error
    listed = isinstance(names, list) and names[:1] == [EMPTY] and all(isinstance(name, str) for name in names)
    if made is None or made.ndim != 3 or not listed or len(names) != len(made):
        raise UserError(f"{path}: holds no {EMBEDDINGS} of texts, the empty one first; {CURE}")
    if not np.isfinite(made).all():
        raise UserError(f"{path}: its {EMBEDDINGS} have values that are not finite; {CURE}")
    if made.shape[1:] != (tokens, width):
        raise UserError(
            f"{path}: its texts have {made.shape[1]} tokens of {made.shape[2]} numbers, the model takes {tokens} of "
            f"{width}; set model.text.tokens and width, or name another file"
        )
    return Texts(tuple(names), made)


def write_texts(names: Sequence[str], embeddings: Float32[np.ndarray, "texts n w"]) -> bytes:
    """Returns the content of a file of embeddings."""
    tensors = {EMBEDDINGS: np.ascontiguousarray(embeddings)}
    metadata = {TEXTS: json.dumps(list(names), ensure_ascii=False)}
    return safetensors.numpy.save(tensors, sealed_metadata(tensors, metadata))


def texts_of(config: TextConfig, tasks: Iterable[str] | None, count: int) -> np.ndarray:
    """Returns the network's input for the tasks of ``count`` clips: embeddings (B, n, w), or numbers of learned ones.

    Args:
        tasks: in words; None: unknown. An unknown task has the empty text, or the only learned one.

    Raises:
        UserError: a task has no embedding, or the file is missing or does not fit.
    """
    if not (config.file or config.tasks):
        return np.ones(count, np.int32)
    wanted = [EMPTY] * count
    if tasks is not None:
        wanted = [EMPTY if task in (None, UNKNOWN) else task for task in tasks]
    check_tasks(config, wanted)
    rows = np.array([_names(config).index(task) for task in wanted], np.int32)
    if config.file:
        return read_texts(config.file, config.tokens, config.width).embeddings[rows]
    return rows


def empty_texts(config: TextConfig, count: int) -> np.ndarray:
    """Returns the network's input for the empty text, as :func:`texts_of` does."""
    if config.file:
        return texts_of(config, None, count)
    return np.zeros(count, np.int32)


def known_tasks(config: TextConfig, tasks: Iterable[str] | None, count: int) -> list[str]:
    """Returns clips' tasks, with the empty text for tasks that have no text; prints one note for each such task."""
    wanted = [UNKNOWN] * count
    if tasks is not None:
        wanted = list(map(str, tasks))
    if not (config.file or config.tasks):
        return wanted
    names = _names(config)
    for task in sorted(set(wanted) - {*names}):
        _note_empty(config, task)
    return [task if task in names else EMPTY for task in wanted]


@lru_cache
def _note_empty(config: TextConfig, task: str) -> None:
    trained = bool(config.file) or config.dropout > 0
    if task == UNKNOWN and trained:
        return
    message = _lacking(config, task)
    if task == UNKNOWN:
        message = "a clip has no task"
    message += ": it reads the empty text"
    if not trained:
        message += ", which training without model.text.dropout shows only for clips without a task"
    if config.file:
        message += f"; {config.file} can be made again with --task {task!r} too"
    note(message)


def check_store(config: TextConfig, store: Store) -> None:
    """Checks the tasks of a store's records, if they are labelled. Errors as in :func:`check_tasks`."""
    for split in filter(store.labelled, store.splits):
        check_tasks(config, store.labels(split).words.get("task", ()))


def check_tasks(config: TextConfig, tasks: Iterable[str]) -> None:
    """Raises :class:`UserError` if a task has no text of its own, or the file is missing or does not fit."""
    if not (config.file or config.tasks):
        return
    missing = sorted(set(tasks) - {*_names(config), UNKNOWN})
    if missing and config.file:
        raise UserError(f"{_lacking(config, missing[0])}; {CURE}")
    if missing:
        raise UserError(f"{_lacking(config, missing[0])}; name it there")


def _lacking(config: TextConfig, task: str) -> str:
    listed = ", ".join(map(repr, _names(config)[1:])) or "none"
    return f"{config.file or 'model.text.tasks'}: no text of the task {task!r}, only of {listed}"


def _names(config: TextConfig) -> tuple[str, ...]:
    if config.file:
        return read_texts(config.file, config.tokens, config.width).names
    return (EMPTY, *config.tasks)
