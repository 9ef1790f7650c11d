"""Reading other people's metadata: JSON, JSON lines, Parquet and NumPy tables, with errors that name file and field."""

import errno
import json
from collections.abc import Iterator, Sequence
from pathlib import Path, PurePosixPath
from string import Formatter
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float32, Float64, Int64

from rsjax.ingest.episode import EpisodeError, EpisodeRef, SourceError, plain

_CURE = "fetch the file again or leave the episode out"
MAX_CELLS = 2**24  # numbers in one episode's table: more is a damaged header
_MOST_BYTES, _MOST_ROWS = 2**32, 2**28  # of a Parquet file, which many episodes may share


def inside(root: Path, relative: str) -> Path:
    """A file of the data set; links are followed (model hubs keep files behind links), ``..`` is not.

    Raises:
        EpisodeError: the name leads out of ``root``.
    """
    parts = PurePosixPath(relative)
    if not relative or parts.is_absolute() or ".." in parts.parts or "\0" in relative:
        raise EpisodeError(f"{root}: its metadata name the file {relative!r}, which is not inside; mend the metadata")
    return root / parts


def filled(template: str, **fields: int | str) -> str:
    """A path template of a data set's metadata, such as ``chunk-{chunk_index:03d}``, with its fields.

    Raises:
        EpisodeError: it names other fields, or formats one in another way than with a width of one digit.
    """
    made = []
    try:
        for text, name, spec, conversion in Formatter().parse(template):
            made.append(text)
            if name is not None:
                if name not in fields or conversion or (spec and not (spec[-1:] == "d" and spec[:-1] in _WIDTHS)):
                    raise ValueError(f"field {name!r} with {spec!r}")
                made.append(format(fields[name], spec or ""))
    except ValueError as error:
        known = ", ".join(fields)
        raise EpisodeError(f"path template {template!r}: {error}; it can have the fields {known}") from error
    return "".join(made)


_WIDTHS = ("", *(f"{zero}{width}" for zero in ("", "0") for width in range(1, 10)))


def media(path: Path) -> Path:
    """As :func:`plain`, for a video or picture that is opened later; what is missing is told then.

    Raises:
        EpisodeError: it is a pipe or a device.
    """
    try:
        return plain(path)
    except OSError as error:
        if error.errno != errno.EINVAL:
            return path
        raise EpisodeError(f"{path}: {_reason(error)}; {_CURE}", "undecodable") from error


def read_json(path: Path) -> Any:
    """A JSON file.

    Raises:
        SourceError: it is missing or damaged.
    """
    try:
        return json.loads(plain(path).read_text("utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise SourceError(f"{path}: {_reason(error)}; fetch the file again") from error


def json_lines(path: Path) -> Iterator[tuple[int, Any]]:
    """(line number from 1, value) of each line that is not empty; a :class:`ValueError` in place of a bad line's.

    Raises:
        SourceError: the file cannot be opened.
    """
    try:
        with plain(path).open("rb") as file:
            for number, line in enumerate(file, 1):
                if line.strip():
                    try:
                        yield number, json.loads(line)
                    except (ValueError, RecursionError) as error:
                        yield number, ValueError(f"not JSON ({error})")
    except OSError as error:
        raise SourceError(f"{path}: {_reason(error)}; fetch the file again") from error


def parquet_rows(path: Path, columns: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Rows of a Parquet file, as many columns of these as it has; a few thousand rows are in memory at a time.

    Raises:
        SourceError: it is missing or damaged.
    """
    try:
        with pq.ParquetFile(plain(path)) as file:
            there = set(file.schema_arrow.names)
            for batch in file.iter_batches(4096, columns=[name for name in columns if name in there]):
                yield from batch.to_pylist()
    except (pa.ArrowException, OSError, ValueError) as error:
        raise SourceError(f"{path}: {_reason(error)}; fetch the file again") from error


def parquet_columns(path: Path, columns: Sequence[str] | None = None, filters: Any = None) -> pa.Table:
    """A Parquet file's columns (of these, those it has), or its rows that pass ``filters``.

    Raises:
        EpisodeError: it is missing or damaged, or too large.
    """
    try:
        with pq.ParquetFile(plain(path)) as file:
            there = file.schema_arrow.names
            chosen = there if columns is None else [name for name in columns if name in there]
            _check_size(file.metadata, MAX_CELLS if filters is None else _MOST_ROWS, path)
        return pq.read_table(path, columns=chosen, filters=filters, partitioning=None)
    except (pa.ArrowException, OSError, ValueError) as error:
        raise EpisodeError(f"{path}: {_reason(error)}; {_CURE}") from error


def _check_size(metadata: pq.FileMetaData, most: int, path: Path) -> None:
    """Raises :class:`EpisodeError` where a table is too large: one number a thousand million times takes few bytes.

    What the file says of each column chunk is not asked: where that is damaged, pyarrow ends the process.
    """
    size = sum(metadata.row_group(number).total_byte_size for number in range(metadata.num_row_groups))
    if metadata.num_rows > most or size > _MOST_BYTES:
        raise EpisodeError(f"{path}: {metadata.num_rows} rows of {size} bytes, more than a table can have; {_CURE}")


def matrix(table: pa.Table, column: str, where: Path | str) -> Float32[np.ndarray, "N A"]:
    """A column of numbers or of lists of numbers, all of one length; what float32 cannot hold is infinite.

    Raises:
        EpisodeError: there is no such column, or it holds something else.
    """
    with np.errstate(over="ignore"):
        return _numbers(table, column, where).astype(np.float32)


def seconds(table: pa.Table, column: str, where: Path | str) -> Float64[np.ndarray, " N"]:
    """A column of times; those that count from 1970 do not fit into float32. Raises as :func:`matrix`."""
    values = _numbers(table, column, where)
    if values.shape[1] != 1:
        raise EpisodeError(f"{where}: column {column!r} has {values.shape[1]} numbers a row, should have one; {_CURE}")
    return values[:, 0]


def _numbers(table: pa.Table, column: str, where: Path | str) -> Float64[np.ndarray, "N A"]:
    if column not in table.column_names:
        raise EpisodeError(f"{where}: has no column {column!r}; it has {', '.join(table.column_names)}")
    kind = inner = table[column].type
    while pa.types.is_list(inner) or pa.types.is_large_list(inner) or pa.types.is_fixed_size_list(inner):
        inner = inner.value_type
    wrong = f"{where}: column {column!r} ({kind}) is not rows of as many numbers; {_CURE}"
    if not any(test(inner) for test in (pa.types.is_integer, pa.types.is_floating, pa.types.is_boolean)):
        raise EpisodeError(wrong)
    if table[column].nbytes > 8 * MAX_CELLS:
        raise EpisodeError(
            f"{where}: column {column!r} has {table[column].nbytes} bytes, more than it can have; {_CURE}"
        )
    try:
        values = np.array(table[column].to_pylist(), np.float64)
    except (ValueError, TypeError) as error:
        raise EpisodeError(wrong) from error
    return values.reshape(len(values), -1) if values.size else np.zeros((len(values), 0))


def integers(table: pa.Table, column: str, where: Path | str) -> Int64[np.ndarray, " N"]:
    """A column of whole numbers.

    Raises:
        EpisodeError: there is no such column, or it holds something else.
    """
    if column not in table.column_names or not pa.types.is_integer(table[column].type) or table[column].null_count:
        raise EpisodeError(f"{where}: has no column {column!r} of whole numbers; {_CURE}")
    return table[column].to_numpy().astype(np.int64)


def load_npy(path: Path) -> np.ndarray:
    """An array of numbers from a .npy file, checked before memory is taken for it.

    Raises:
        EpisodeError: it is missing, damaged, too large or of another kind.
    """
    try:
        mapped = np.load(plain(path), mmap_mode="r", allow_pickle=False)
        if not isinstance(mapped, np.ndarray) or mapped.dtype.kind not in "fiub" or mapped.size > MAX_CELLS:
            raise ValueError(f"holds no table of numbers but {getattr(mapped, 'dtype', type(mapped).__name__)}")
        return np.array(mapped)
    except (OSError, ValueError, EOFError) as error:
        raise EpisodeError(f"{path}: {_reason(error)}; {_CURE}") from error


def broken(identity: str, message: str) -> EpisodeRef:
    """A reference to an episode that is known to be unreadable, so that a run counts it."""
    return EpisodeRef(identity, "0" * 16, {"error": message})


def location_of(ref: EpisodeRef) -> dict[str, Any]:
    """Where an episode is.

    Raises:
        EpisodeError: it is a :func:`broken` one.
    """
    if "error" in ref.location:
        raise EpisodeError(ref.location["error"])
    return ref.location


def is_there(path: Path) -> bool:
    """Whether there is such a file or folder.

    Raises:
        SourceError: a folder on the way to it may not be looked into.
    """
    try:
        return path.exists()
    except OSError as error:
        raise SourceError(f"{path}: {_reason(error)}; check the place and its permissions") from error


def subfolders(path: Path) -> list[Path]:
    """The folders in a folder by name, numbers in their order; links that lead nowhere may have been some.

    Raises:
        SourceError: the folder cannot be listed.
    """
    try:
        found = [entry for entry in path.iterdir() if _is_folder(entry) and not entry.name.startswith(".")]
    except OSError as error:
        raise SourceError(f"{path}: {_reason(error)}; check the place and its permissions") from error
    return sorted(found, key=lambda entry: (not entry.name.isdecimal(), len(entry.name), entry.name))


def _is_folder(path: Path) -> bool:
    return path.is_dir() or (path.is_symlink() and not path.exists() and not path.suffix)


def _reason(error: Exception) -> str:
    if isinstance(error, FileNotFoundError):
        return "missing"
    if isinstance(error, OSError) and error.strerror:
        return f"cannot be read ({error.strerror})"
    return f"cannot be read ({' '.join(str(error).split())[:200] or type(error).__name__})"
