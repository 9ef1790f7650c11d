"""Stores from elsewhere: their manifests are checked before a file that they name is touched."""

import json
from pathlib import Path, PurePosixPath
from typing import Any

from rsjax.data.store import FORMAT, MANIFEST, Store, StoreError, open_store


def open_foreign(path: Path | str) -> Store:
    """Opens a store whose manifest somebody else may have written.

    Raises:
        StoreError: as :func:`rsjax.data.store.open_store`; and where the manifest is no object of the expected fields,
            names a file outside its directory, or it or a file cannot be reached (permissions, a loop of links).
    """
    path = Path(path)
    try:
        manifest = json.loads((path / MANIFEST).read_text())
    except FileNotFoundError:
        return open_store(path)  # which says it
    except ValueError as error:  # not JSON, or not even text
        raise StoreError(f"{path / MANIFEST}: not JSON ({error}); get the store again") from error
    except OSError as error:
        raise StoreError(
            f"{path / MANIFEST}: cannot be read ({error.strerror}); mend the link or permission"
        ) from error
    _check(path / MANIFEST, manifest)
    try:
        return open_store(path)
    except OSError as error:
        raise StoreError(f"{error.filename or path}: {error.strerror}; mend the link or permission") from error


def _check(where: Path, manifest: Any) -> None:
    fields = manifest if isinstance(manifest, dict) else {}
    _require(where, "format", isinstance(manifest, dict) and "format" in fields)
    if fields["format"] != FORMAT:
        return  # open_store says it
    _require(where, "splits", isinstance(fields.get("splits"), dict))
    for split, entry in fields["splits"].items():
        name = f"splits.{split}"
        _require(where, name, isinstance(entry, dict) and isinstance(entry.get("files"), list))
        for number, file in enumerate(entry["files"]):
            _check_file(where, f"{name}.files.{number}", file, counted=True)
        if "labels" in entry:
            _check_file(where, f"{name}.labels", entry["labels"], counted=False)
            _require(where, f"{name}.labels.words", isinstance(entry["labels"].get("words"), dict))


def _check_file(where: Path, field: str, file: Any, counted: bool) -> None:
    _require(where, field, isinstance(file, dict))
    name = file.get("name")
    plain = isinstance(name, str) and name not in ("", ".", "..") and PurePosixPath(name).name == name
    if not plain or "\\" in name or "\0" in name:
        raise StoreError(f"{where}: {field}.name is {name!r:.80}, not a file beside it; get the store again")
    for number in ("bytes", "count") if counted else ("bytes",):
        value = file.get(number)
        _require(where, f"{field}.{number}", isinstance(value, int) and 0 <= value < 2**50)


def _require(where: Path, field: str, holds: bool) -> None:
    if not holds:
        raise StoreError(f"{where}: {field} is missing or not what it should be; get the store again")
