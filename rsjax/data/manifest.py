"""Checks a store's manifest, which may come from elsewhere, before any file that it names is opened."""

from pathlib import PurePosixPath
from typing import Any

FORMAT = 1
MOST = 2**50  # bytes or records
NUMBER = (int, float)
# The types of fields that may be missing or null, and, for lists and objects, the types of their values.
OPTIONAL: dict[str, tuple[tuple[type, ...], tuple[type, ...]]] = {
    "kind": ((str,), ()),
    "key": ((str,), ()),
    "tokenizer": ((str,), ()),
    "source": ((str,), ()),
    "depth_unit": ((str,), ()),
    "success_share": (NUMBER, ()),
    "action_count": ((int,), ()),
    "config": ((dict,), ()),
    "episodes": ((dict,), (list,)),
    "counts": ((dict,), (int, dict)),
    "filtered": ((dict,), ()),
    "quarantine": ((dict,), ()),
    "depth_range": ((list,), NUMBER),
    "action_dimensions": ((list,), ()),
    **{f"action_{name}": ((list,), NUMBER) for name in ("mean", "std", "min", "max")},
}


class ManifestError(Exception):
    """Says what is wrong with a manifest. The message names the field, but neither the file nor the cure."""


def check_manifest(manifest: dict[str, Any]) -> None:
    """Checks that a manifest has the fields that a store needs and names nothing outside its directory.

    Raises:
        ManifestError: a field is missing, has the wrong type, or names something outside the directory.
    """
    _require("format", "format" in manifest)
    if manifest["format"] != FORMAT:
        raise ManifestError(f"format {manifest['format']!r:.80}, this code reads format {FORMAT}")
    _require("splits", isinstance(manifest.get("splits"), dict))
    for name, (kinds, inner) in OPTIONAL.items():
        if (value := manifest.get(name)) is not None:
            _require(name, type(value) in kinds)
            if inner:
                items = value.values() if isinstance(value, dict) else value
                _require(name, all(type(item) in inner for item in items))
    windows = (manifest.get("counts") or {}).get("windows", {})
    _require("counts.windows", isinstance(windows, dict) and all(type(count) is int for count in windows.values()))
    _require("config.control_steps", type((manifest.get("config") or {}).get("control_steps", 1)) is int)
    for split, entry in manifest["splits"].items():
        name = f"splits.{split}"
        if not _is_plain(split):
            raise ManifestError(f"splits has {split!r:.80}, which cannot be the name of a file")
        _require(name, isinstance(entry, dict) and isinstance(entry.get("files"), list))
        for number, file in enumerate(entry["files"]):
            _check_file(f"{name}.files.{number}", file, ("bytes", "count"))
            if file["count"] > file["bytes"]:
                counts = f"{file['count']}, more than its {file['bytes']} bytes hold"
                raise ManifestError(f"{name}.files.{number}.count is {counts}")
        if "labels" in entry:
            _check_file(f"{name}.labels", entry["labels"], ("bytes",))
            words = entry["labels"].get("words")
            sound = isinstance(words, dict) and all(isinstance(column, list) for column in words.values())
            _require(f"{name}.labels.words", sound and all(isinstance(w, str) for c in words.values() for w in c))
            _require(f"{name}.labels.crc32", type(entry["labels"].get("crc32")) is int)


def _check_file(field: str, file: Any, numbers: tuple[str, ...]) -> None:
    _require(field, isinstance(file, dict))
    if not _is_plain(file.get("name")):
        raise ManifestError(f"{field}.name is {file.get('name')!r:.80}, not a file beside it")
    for number in numbers:
        value = file.get(number)
        _require(f"{field}.{number}", type(value) is int and 0 <= value < MOST)


def _is_plain(name: Any) -> bool:
    """Returns whether this is a file name without a folder."""
    named = isinstance(name, str) and name not in ("", ".", "..") and PurePosixPath(name).name == name
    return named and not {"\\", "\0"} & set(name)


def _require(field: str, holds: bool) -> None:
    if not holds:
        raise ManifestError(f"{field} is missing or not what it should be")
