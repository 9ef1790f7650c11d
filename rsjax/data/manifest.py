"""Manifests of stores, which may come from elsewhere, are checked before a file that they name is touched."""

from pathlib import PurePosixPath
from typing import Any

_MOST = 2**50  # bytes or records
_KINDS: dict[str, type] = {  # what a manifest may have beside its files, and what others rely on
    "episodes": dict,
    "counts": dict,
    "filtered": dict,
    "quarantine": dict,
    "action_mean": list,
    "action_std": list,
}


class ManifestError(Exception):
    """What is wrong with a manifest, without the file and the cure."""


def check_manifest(manifest: Any, version: int) -> None:
    """Asks whether a manifest has the fields that a store needs, and names nothing outside its directory.

    Args:
        manifest: the content of the JSON file.
        version: of the manifests that can be read.

    Raises:
        ManifestError: it has not, or does.
    """
    _require("format", isinstance(manifest, dict) and "format" in manifest)
    if manifest["format"] != version:
        raise ManifestError(f"format {manifest['format']!r:.80}, this code reads format {version}")
    _require("splits", isinstance(manifest.get("splits"), dict))
    for name, kind in _KINDS.items():
        _require(name, isinstance(manifest.get(name) or kind(), kind))
    for split, entry in manifest["splits"].items():
        name = f"splits.{split}"
        if not _is_plain(split):
            raise ManifestError(f"splits has {split!r:.80}, which cannot be the name of a file")
        _require(name, isinstance(entry, dict) and isinstance(entry.get("files"), list))
        for number, file in enumerate(entry["files"]):
            _check_file(f"{name}.files.{number}", file, counted=True)
        if "labels" in entry:
            _check_file(f"{name}.labels", entry["labels"], counted=False)
            _require(f"{name}.labels.words", isinstance(entry["labels"].get("words"), dict))
            _require(f"{name}.labels.crc32", type(entry["labels"].get("crc32")) is int)


def _check_file(field: str, file: Any, counted: bool) -> None:
    _require(field, isinstance(file, dict))
    name = file.get("name")
    if not _is_plain(name):
        raise ManifestError(f"{field}.name is {name!r:.80}, not a file beside it")
    for number in ("bytes", "count") if counted else ("bytes",):
        value = file.get(number)
        _require(f"{field}.{number}", type(value) is int and 0 <= value < _MOST)
    if counted and file["count"] > file["bytes"]:
        raise ManifestError(f"{field}.count is {file['count']}, more than its {file['bytes']} bytes hold")


def _is_plain(name: Any) -> bool:
    """Whether it is the name of a file, without a folder."""
    named = isinstance(name, str) and name not in ("", ".", "..") and PurePosixPath(name).name == name
    return named and not {"\\", "\0"} & set(name)


def _require(field: str, holds: bool) -> None:
    if not holds:
        raise ManifestError(f"{field} is missing or not what it should be")
