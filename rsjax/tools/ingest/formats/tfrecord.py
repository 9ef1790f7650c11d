"""Reads TFRecord files and the ``tf.train.Example`` messages in them, without TensorFlow.

A record has its length (uint64), a checksum of the length, the payload and a checksum of the payload, all
little-endian. Checksums are CRC-32C, rotated and offset ("masked"). Grain's own reader checks neither of them.
"""

import struct
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

import google_crc32c
import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory, text_format
from google.protobuf.message import DecodeError
from jaxtyping import Float32

from rsjax.tools.ingest.episode import EpisodeError, EpisodeRef, data_file, fingerprint
from rsjax.tools.ingest.formats.files import broken, inside, location_of, reading

_HEAD = 12  # bytes before a payload
_FOOT = 4  # bytes after it
_PROTO = """
name: "rsjax/example.proto" package: "tensorflow" syntax: "proto3"
message_type { name: "BytesList" field { name: "value" number: 1 type: TYPE_BYTES label: LABEL_REPEATED } }
message_type { name: "FloatList" field { name: "value" number: 1 type: TYPE_FLOAT label: LABEL_REPEATED } }
message_type { name: "Int64List" field { name: "value" number: 1 type: TYPE_INT64 label: LABEL_REPEATED } }
message_type {
  name: "Feature"
  oneof_decl { name: "kind" }
  field { name: "bytes_list" number: 1 type_name: ".tensorflow.BytesList" label: LABEL_OPTIONAL oneof_index: 0 }
  field { name: "float_list" number: 2 type_name: ".tensorflow.FloatList" label: LABEL_OPTIONAL oneof_index: 0 }
  field { name: "int64_list" number: 3 type_name: ".tensorflow.Int64List" label: LABEL_OPTIONAL oneof_index: 0 }
}
message_type {
  name: "Features"
  nested_type {
    name: "FeatureEntry"
    options { map_entry: true }
    field { name: "key" number: 1 type: TYPE_STRING label: LABEL_OPTIONAL }
    field { name: "value" number: 2 type_name: ".tensorflow.Feature" label: LABEL_OPTIONAL }
  }
  field { name: "feature" number: 1 type_name: ".tensorflow.Features.FeatureEntry" label: LABEL_REPEATED }
}
message_type {
  name: "Example"
  field { name: "features" number: 1 type_name: ".tensorflow.Features" label: LABEL_OPTIONAL }
}
"""


def spans(path: Path) -> Iterator[tuple[int, int, int]]:
    """Yields each record's offset and payload length, both in bytes, and the masked checksum after the payload.

    It reads only heads and checksums.

    Raises:
        EpisodeError: the file cannot be read, or is damaged after the last record that was yielded.
    """
    offset = 0
    with reading(path), data_file(path).open("rb") as file:
        size = path.stat().st_size
        while offset < size:
            file.seek(offset)
            head = file.read(_HEAD)
            if len(head) < _HEAD:
                raise EpisodeError.at(path, f"truncated: {len(head)} bytes where a record's head takes {_HEAD}")
            length, check = struct.unpack("<QI", head)
            if check != masked_crc(head[:8]):
                raise EpisodeError.at(path, "the checksum of a record's length is wrong")
            end = offset + _HEAD + length + _FOOT
            if end > size:
                raise EpisodeError.at(path, f"truncated: a record ends at byte {end}, the file at byte {size}")
            file.seek(end - _FOOT)
            yield offset, length, int.from_bytes(file.read(_FOOT), "little")
            offset = end


def record_refs(root: Path, file: str, ids: str, expected: tuple[int, str], settings: Any) -> Iterator[EpisodeRef]:
    """Lists the records of a file as episodes; one unreadable episode stands for all that a damaged file lacks.

    Args:
        root: folder of the data set.
        file: the file, relative to ``root``.
        ids: template of the episodes' ids, which their number completes.
        expected: how many records there should be, and words for what says so.
        settings: what else the episodes depend on, for their fingerprints.
    """
    number = 0
    try:
        for number, (offset, length, crc) in enumerate(spans(root / file), 1):
            mark = fingerprint((), file, length, crc, "", settings)
            yield EpisodeRef(ids.format(number - 1), mark, {"file": file, "offset": offset, "length": length})
        if number < expected[0]:
            raise EpisodeError.at(root / file, f"has {number} of the {expected[0]} records that {expected[1]}")
    except EpisodeError as error:
        yield broken(ids.format(number), str(error))


def read_record(root: Path, ref: EpisodeRef) -> "Example":
    """Reads the record of a reference from :func:`record_refs`; raises :class:`EpisodeError` if it is damaged."""
    location = location_of(ref)
    path = inside(root, location["file"])
    return Example(read_payload(path, location["offset"], location["length"]), f"{path}: record {ref.id}")


def read_payload(path: Path, offset: int, length: int) -> bytes:
    """Returns the payload of a record at a place from :func:`spans`.

    Raises:
        EpisodeError: the file cannot be read, has changed, or its checksum is wrong.
    """
    with reading(path), data_file(path).open("rb") as file:
        file.seek(offset)
        record = file.read(_HEAD + length + _FOOT)
    if len(record) < _HEAD + length + _FOOT or int.from_bytes(record[:8], "little") != length:
        raise EpisodeError(f"{path}: no record of {length} bytes at byte {offset}: the file has changed; list it again")
    payload = record[_HEAD:-_FOOT]
    if masked_crc(payload) != int.from_bytes(record[-_FOOT:], "little"):
        raise EpisodeError.at(path, f"the checksum of the record at byte {offset} is wrong")
    return payload


class Example:
    """A decoded message: lists of values by the feature's name.

    Args:
        payload: the encoded message.
        where: the file and record that error messages name.

    Raises:
        EpisodeError: the payload is not a ``tf.train.Example``.
    """

    def __init__(self, payload: bytes, where: str) -> None:
        self.where = where
        try:
            self._features = message_class().FromString(payload).features.feature
        except DecodeError as error:
            raise EpisodeError.at(where, f"no tf.train.Example ({error})") from error

    def __contains__(self, name: str) -> bool:
        return name in self._features

    def names(self) -> list[str]:
        return sorted(self._features)

    def numbers(self, name: str, rows: int) -> Float32[np.ndarray, "T n"]:
        """Returns a feature of floats or integers, split into this many rows.

        Raises:
            EpisodeError: there is no such feature, its values are of another type, or they do not fill the rows.
        """
        values = self._values(name, ("float_list", "int64_list"))
        if rows == 0 or not len(values) or len(values) % rows:
            raise EpisodeError.at(self.where, f"{name} has {len(values)} values for {rows} steps")
        return np.array(values, np.float32).reshape(rows, -1)

    def flat(self, name: str) -> tuple[Float32[np.ndarray, " n"], bool]:
        """Returns the numbers of a feature, and whether they are floats. Raises as :meth:`numbers`."""
        values = self._values(name, ("float_list", "int64_list"))
        return np.array(values, np.float32), self._features[name].WhichOneof("kind") == "float_list"

    def blobs(self, name: str) -> list[bytes]:
        """Returns a feature of byte strings. Raises as :meth:`numbers`."""
        return list(self._values(name, ("bytes_list",)))

    def is_bytes(self, name: str) -> bool:
        """Returns whether a feature's values are byte strings."""
        return name in self and self._features[name].WhichOneof("kind") == "bytes_list"

    def plain(self, name: str) -> list[str | int | float]:
        """Returns a feature's values of any kind, JSON-ready; byte strings become text."""
        values = self._values(name, ("bytes_list", "float_list", "int64_list"))
        return [value.decode("utf-8", "replace") if isinstance(value, bytes) else value for value in values]

    def _values(self, name: str, kinds: tuple[str, ...]) -> Any:
        if name not in self._features:
            raise EpisodeError.at(self.where, f"has no {name}", "check the key map, or leave the episode out")
        feature = self._features[name]
        kind = feature.WhichOneof("kind")
        if kind not in kinds:
            raise EpisodeError.at(self.where, f"{name} is {kind or 'empty'}, should be {' or '.join(kinds)}")
        return getattr(feature, kind).value


@lru_cache(maxsize=1)
def message_class() -> Any:
    """Returns the message class ``tf.train.Example``, from a separate pool, so that TensorFlow can be imported too."""
    pool = descriptor_pool.DescriptorPool()
    pool.Add(text_format.Parse(_PROTO, descriptor_pb2.FileDescriptorProto()))
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("tensorflow.Example"))


def masked_crc(data: bytes) -> int:
    """Returns the masked checksum that TFRecord files store."""
    crc = google_crc32c.value(data)
    return (((crc >> 15) | (crc << 17)) + 0xA282EAD8) & 0xFFFFFFFF
