"""Reads other people's files (JSON, JSON lines, Parquet, NumPy tables) with errors that name file and field."""

import errno
import json
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from string import Formatter
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Float32, Float64, Int64

from rsjax.files import regular
from rsjax.tools.ingest.episode import EpisodeError, EpisodeRef, SourceError, data_file, fingerprint, reason

MAX_CELLS = 2**24  # numbers in one episode's table; more mean a damaged header
_MOST_BYTES = 2**32  # of a Parquet file, which many episodes may share
_MOST_ROWS = 2**28  # likewise


@contextmanager
def reading(path: Path, whole_source: bool = False) -> Iterator[None]:
    """Turns the errors of a missing or damaged file into :class:`EpisodeError`.

    Args:
        path: the file, which error messages name.
        whole_source: whether the whole data set is unreadable without the file; the error is then :class:`SourceError`.
    """
    try:
        yield
    except (pa.ArrowException, OSError, ValueError, EOFError, RecursionError) as error:
        if whole_source:
            raise SourceError(f"{path}: {reason(error)}; fetch the file again") from error
        raise EpisodeError.at(path, reason(error)) from error


@contextmanager
def looking(path: Path) -> Iterator[None]:
    """Turns the errors of a folder that cannot be listed or entered into :class:`SourceError`."""
    try:
        yield
    except OSError as error:
        raise SourceError(f"{path}: {reason(error)}; check the place and its permissions") from error


def inside(root: Path, relative: str) -> Path:
    """Returns a file of the data set; links are followed (model hubs keep files behind links), but ``..`` is refused.

    Raises:
        EpisodeError: the name leads out of ``root``.
    """
    parts = PurePosixPath(relative)
    if not relative or parts.is_absolute() or ".." in parts.parts or "\0" in relative:
        raise EpisodeError(f"{root}: its metadata name the file {relative!r}, which is not inside; mend the metadata")
    return root / parts


def fill(template: str, **fields: int | str) -> str:
    """Fills in a path template of a data set's metadata, such as ``chunk-{chunk_index:03d}``.

    Raises:
        EpisodeError: the template names other fields, or has a format other than a width of one digit.
    """
    filled = []
    try:
        for text, name, spec, conversion in Formatter().parse(template):
            filled.append(text)
            if name is not None:
                if name not in fields or conversion or not re.fullmatch("((0?[1-9])?d)?", spec or ""):
                    raise ValueError(f"field {name!r} with {spec!r}")
                filled.append(format(fields[name], spec or ""))
    except ValueError as error:
        known = ", ".join(fields)
        raise EpisodeError(f"path template {template!r}: {error}; it can have the fields {known}") from error
    return "".join(filled)


def media(path: Path) -> Path:
    """Returns the path of a video or picture that is opened later; only opening it shows whether it exists.

    Raises:
        EpisodeError: the path is a pipe or a device.
    """
    try:
        return regular(path)
    except OSError as error:
        if error.errno != errno.EINVAL:
            return path
        raise EpisodeError.at(path, reason(error), kind="undecodable") from error


def read_json(path: Path) -> Any:
    """Reads a JSON file; :class:`SourceError` if it is missing or damaged."""
    with reading(path, whole_source=True):
        return json.loads(data_file(path).read_text("utf-8"))


def json_lines(path: Path) -> Iterator[tuple[int, Any]]:
    """Yields the number (from 1) and the value of each nonempty line; the value of a bad line is a :class:`ValueError`.

    Raises:
        SourceError: the file cannot be opened.
    """
    with reading(path, whole_source=True), data_file(path).open("rb") as file:
        for number, line in enumerate(file, 1):
            if line.strip():
                try:
                    value = json.loads(line)
                except (ValueError, RecursionError) as error:
                    value = ValueError(f"not JSON ({error})")
                yield number, value


def parquet_rows(path: Path, columns: Sequence[str]) -> Iterator[dict[str, Any]]:
    """Yields the rows of a Parquet file, with those of ``columns`` that it has; holds a few thousand rows at a time.

    Raises:
        SourceError: the file is missing or damaged.
    """
    with reading(path, whole_source=True), pq.ParquetFile(data_file(path)) as file:
        names = set(file.schema_arrow.names)
        for batch in file.iter_batches(4096, columns=[name for name in columns if name in names]):
            yield from batch.to_pylist()


def parquet_columns(path: Path, columns: Sequence[str] | None = None, filters: Any = None) -> pa.Table:
    """Reads a Parquet file: those of ``columns`` that it has, and the rows that pass ``filters``.

    Raises:
        EpisodeError: the file is missing, damaged or too large when unpacked: a few bytes can encode a thousand million
            equal numbers.
    """
    with reading(path):
        with pq.ParquetFile(data_file(path)) as file:
            names = file.schema_arrow.names
            if columns is None:
                chosen = names
            else:
                chosen = [name for name in columns if name in names]
            # The metadata of column chunks is not read: if it is damaged, pyarrow ends the process.
            count = file.metadata.num_rows
            size = sum(file.metadata.row_group(number).total_byte_size for number in range(file.num_row_groups))
            if count > (MAX_CELLS if filters is None else _MOST_ROWS) or size > _MOST_BYTES:
                raise EpisodeError.at(path, f"{count} rows of {size} bytes, more than a table can have")
        return pq.read_table(path, columns=chosen, filters=filters, partitioning=None)


def matrix(table: pa.Table, column: str, where: Path | str) -> Float32[np.ndarray, "N A"]:
    """Returns a column of numbers or of lists of numbers, all of one length; values beyond float32 become infinite.

    Raises:
        EpisodeError: there is no such column, or it contains something else.
    """
    with np.errstate(over="ignore"):
        return _numbers(table, column, where).astype(np.float32)


def seconds(table: pa.Table, column: str, where: Path | str) -> Float64[np.ndarray, " N"]:
    """Returns a column of times in float64, since times since 1970 do not fit float32. Raises as :func:`matrix`."""
    values = _numbers(table, column, where)
    if values.shape[1] != 1:
        raise EpisodeError.at(where, f"column {column!r} has {values.shape[1]} numbers a row, should have one")
    return values[:, 0]


def _numbers(table: pa.Table, column: str, where: Path | str) -> Float64[np.ndarray, "N A"]:
    if column not in table.column_names:
        raise EpisodeError(f"{where}: has no column {column!r}; it has {', '.join(table.column_names)}")
    kind = table[column].type
    inner = kind
    while pa.types.is_list(inner) or pa.types.is_large_list(inner) or pa.types.is_fixed_size_list(inner):
        inner = inner.value_type
    wrong = EpisodeError.at(where, f"column {column!r} ({kind}) is not rows of as many numbers")
    if not any(test(inner) for test in (pa.types.is_integer, pa.types.is_floating, pa.types.is_boolean)):
        raise wrong
    if table[column].nbytes > 8 * MAX_CELLS:
        raise EpisodeError.at(where, f"column {column!r} has {table[column].nbytes} bytes, more than it can have")
    try:
        values = np.array(table[column].to_pylist(), np.float64)
    except (ValueError, TypeError) as error:
        raise wrong from error
    if values.size:
        return values.reshape(len(values), -1)
    return np.zeros((len(values), 0))


def integers(table: pa.Table, column: str, where: Path | str) -> Int64[np.ndarray, " N"]:
    """Returns a column of whole numbers.

    Raises:
        EpisodeError: there is no such column, or it contains something else.
    """
    if column not in table.column_names or not pa.types.is_integer(table[column].type) or table[column].null_count:
        raise EpisodeError.at(where, f"has no column {column!r} of whole numbers")
    return table[column].to_numpy().astype(np.int64)


def load_npy(path: Path) -> np.ndarray:
    """Reads an array of numbers from a .npy file, after checking its header and before allocating memory.

    Raises:
        EpisodeError: the file is missing, damaged, too large or of another kind.
    """
    with reading(path):
        mapped = np.load(data_file(path), mmap_mode="r", allow_pickle=False)
        if not isinstance(mapped, np.ndarray) or mapped.dtype.kind not in "fiub" or mapped.size > MAX_CELLS:
            raise ValueError(f"no table of numbers but {getattr(mapped, 'dtype', type(mapped).__name__)}")
        return np.array(mapped)


def broken(identity: str, message: str) -> EpisodeRef:
    """Returns a reference to an episode that is known to be unreadable, so that a run counts it."""
    return EpisodeRef(identity, fingerprint((), message), {"error": message})


def location_of(ref: EpisodeRef) -> dict[str, Any]:
    """Returns where an episode is; raises :class:`EpisodeError` with its message for a :func:`broken` reference."""
    if "error" in ref.location:
        raise EpisodeError(ref.location["error"])
    return ref.location


def exists(path: Path) -> bool:
    """Returns whether the file or folder exists; raises :class:`SourceError` if a parent folder cannot be entered."""
    with looking(path):
        return path.exists()


def subfolders(path: Path) -> list[Path]:
    """Lists the folders in a folder by name, numbers in numeric order, including broken links without a suffix.

    Raises:
        SourceError: the folder cannot be listed.
    """
    with looking(path):
        folders = [
            entry
            for entry in path.iterdir()
            if (entry.is_dir() or (entry.is_symlink() and not entry.exists() and not entry.suffix))
            and not entry.name.startswith(".")
        ]
    return sorted(folders, key=lambda entry: (not entry.name.isdecimal(), len(entry.name), entry.name))


def near(path: Path, pattern: str) -> list[Path]:
    """Lists the files that match a pattern in a folder and its subfolders down to two levels."""
    return [file for depth in ("", "*/", "*/*/") for file in path.glob(f"{depth}{pattern}") if file.is_file()]
