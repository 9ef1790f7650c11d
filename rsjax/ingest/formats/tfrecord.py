"""TFRecord files and the ``tf.train.Example`` messages in them, without TensorFlow.

A record is: its length (uint64), a checksum of that, the payload, a checksum of that; all little-endian. Checksums are
CRC-32C, rotated and offset ("masked"). The library that Grain brings reads such files but checks neither.
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import IO, Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError
from jaxtyping import Float32, UInt32

from rsjax.ingest.episode import EpisodeError, plain

_HEAD, _FOOT = 12, 4  # bytes around a payload
_POLYNOMIAL = 0x82F63B78  # of CRC-32C, bits reversed
_BLOCK = 256  # bytes that one lane of the checksum takes
_CURE = "fetch the file again or leave the episode out"


@dataclass(frozen=True)
class Span:
    """Where a record lies in its file.

    Attributes:
        offset: bytes to its head.
        length: bytes of its payload.
        crc: the payload's masked checksum, as it is written in the file.
        damage: why neither this record nor what follows it in the file can be read; "" where it can.
    """

    offset: int
    length: int
    crc: int = 0
    damage: str = ""


def spans(path: Path) -> Iterator[Span]:
    """Every record of a file, in order, from the heads alone. Where the file is damaged, the last one says how."""
    try:
        with plain(path).open("rb") as file:
            yield from _spans(file, path.stat().st_size)
    except OSError as error:
        yield Span(0, 0, damage=f"cannot be read ({error.strerror})")


def _spans(file: IO[bytes], size: int) -> Iterator[Span]:
    offset = 0
    while offset < size:
        file.seek(offset)
        head = file.read(_HEAD)
        if len(head) < _HEAD:
            yield Span(offset, 0, damage=f"truncated: {len(head)} bytes where a record's head takes {_HEAD}")
            return
        length, check = struct.unpack("<QI", head)
        if check != masked_crc(head[:8]):
            yield Span(offset, 0, damage="the checksum of a record's length is wrong")
            return
        end = offset + _HEAD + length + _FOOT
        if end > size:
            yield Span(offset, 0, damage=f"truncated: a record ends at byte {end}, the file at byte {size}")
            return
        file.seek(end - _FOOT)
        yield Span(offset, length, int.from_bytes(file.read(_FOOT), "little"))
        offset = end


def read_payload(path: Path, offset: int, length: int) -> bytes:
    """The payload of the record that :func:`spans` found there.

    Raises:
        EpisodeError: the file cannot be read, has changed, or its checksum is wrong.
    """
    try:
        with plain(path).open("rb") as file:
            file.seek(offset)
            record = file.read(_HEAD + length + _FOOT)
    except OSError as error:
        raise EpisodeError(f"{path}: cannot be read ({error.strerror}); {_CURE}") from error
    if len(record) < _HEAD + length + _FOOT or int.from_bytes(record[:8], "little") != length:
        raise EpisodeError(f"{path}: no record of {length} bytes at byte {offset}: the file has changed; list it again")
    payload = record[_HEAD:-_FOOT]
    if masked_crc(payload) != int.from_bytes(record[-_FOOT:], "little"):
        raise EpisodeError(f"{path}: the checksum of the record at byte {offset} is wrong; {_CURE}")
    return payload


class Example:
    """One message: lists of values by the feature's name.

    Args:
        payload: the message.
        where: the file and record that messages name.

    Raises:
        EpisodeError: it is no ``tf.train.Example``.
    """

    def __init__(self, payload: bytes, where: str) -> None:
        self.where = where
        try:
            self._features = message_class().FromString(payload).features.feature
        except DecodeError as error:
            raise EpisodeError(f"{where}: no tf.train.Example ({error}); {_CURE}") from error

    def __contains__(self, name: str) -> bool:
        return name in self._features

    def names(self) -> list[str]:
        return sorted(self._features)

    def numbers(self, name: str, rows: int) -> Float32[np.ndarray, "T n"]:
        """A feature of floats or integers, cut into this many rows.

        Raises:
            EpisodeError: there is no such feature, it has other values, or they do not fill the rows.
        """
        values = self._values(name, ("float_list", "int64_list"))
        if rows == 0 or not len(values) or len(values) % rows:
            raise EpisodeError(f"{self.where}: {name} has {len(values)} values for {rows} steps; {_CURE}")
        return np.array(values, np.float32).reshape(rows, -1)

    def blobs(self, name: str) -> list[bytes]:
        """A feature of byte strings. Raises as :meth:`numbers`."""
        return list(self._values(name, ("bytes_list",)))

    def holds_bytes(self, name: str) -> bool:
        """Whether a feature's values are byte strings."""
        return self._features[name].WhichOneof("kind") == "bytes_list"

    def plain(self, name: str) -> list[str | int | float]:
        """A feature's values of whatever kind, JSON-ready; byte strings as text."""
        values = self._values(name, ("bytes_list", "float_list", "int64_list"))
        return [value.decode("utf-8", "replace") if isinstance(value, bytes) else value for value in values]

    def _values(self, name: str, kinds: tuple[str, ...]) -> Any:
        if name not in self._features:
            raise EpisodeError(f"{self.where}: has no {name}; check the key map, or leave the episode out")
        feature = self._features[name]
        kind = feature.WhichOneof("kind")
        if kind not in kinds:
            raise EpisodeError(f"{self.where}: {name} is {kind or 'empty'}, should be {' or '.join(kinds)}; {_CURE}")
        return getattr(feature, kind).value


@lru_cache(maxsize=1)
def message_class() -> Any:
    """The message ``tf.train.Example``. In a pool of its own, so that TensorFlow may be imported besides."""
    kind = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="rsjax/example.proto", package="tensorflow", syntax="proto3")
    lists = (("BytesList", kind.TYPE_BYTES), ("FloatList", kind.TYPE_FLOAT), ("Int64List", kind.TYPE_INT64))
    for name, scalar in lists:
        file.message_type.add(name=name).field.add(name="value", number=1, type=scalar, label=kind.LABEL_REPEATED)
    feature = file.message_type.add(name="Feature")
    feature.oneof_decl.add(name="kind")
    for number, name in enumerate(("bytes_list", "float_list", "int64_list"), 1):
        field = _message_field(feature, name, number, lists[number - 1][0])
        field.oneof_index = 0
    features = file.message_type.add(name="Features")
    entry = features.nested_type.add(name="FeatureEntry")
    entry.options.map_entry = True
    entry.field.add(name="key", number=1, type=kind.TYPE_STRING, label=kind.LABEL_OPTIONAL)
    _message_field(entry, "value", 2, "Feature")
    _message_field(features, "feature", 1, "Features.FeatureEntry").label = kind.LABEL_REPEATED
    _message_field(file.message_type.add(name="Example"), "features", 1, "Features")
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("tensorflow.Example"))


def _message_field(message: Any, name: str, number: int, of: str) -> Any:
    kind = descriptor_pb2.FieldDescriptorProto
    return message.field.add(
        name=name, number=number, type=kind.TYPE_MESSAGE, label=kind.LABEL_OPTIONAL, type_name=f".tensorflow.{of}"
    )


def masked_crc(data: bytes) -> int:
    """The checksum as TFRecord files hold it."""
    crc = crc32c(data)
    return (((crc >> 15) | (crc << 17)) + 0xA282EAD8) & 0xFFFFFFFF


def crc32c(data: bytes) -> int:
    """CRC-32C (Castagnoli), in numpy: many blocks at once, whose checksums are then joined in pairs.

    A checksum is linear in its data but for its start value, which equals inverting the first four bytes; leading
    zeros change nothing. So data is filled up to a power of two of blocks.
    """
    if len(data) < 4:
        short = 0xFFFFFFFF
        for byte in data:
            short = int(_table()[(short ^ byte) & 0xFF]) ^ (short >> 8)
        return short ^ 0xFFFFFFFF
    lanes = 1 << max(0, -(-len(data) // _BLOCK) - 1).bit_length()
    filled = np.zeros(lanes * _BLOCK, np.uint8)
    filled[-len(data) :] = np.frombuffer(data, np.uint8)
    filled[-len(data) :][:4] ^= 0xFF
    register = _feed(np.zeros(lanes, np.uint32), np.ascontiguousarray(filled.reshape(lanes, _BLOCK).T))
    level = 0
    while len(register) > 1:
        register = _apply(_advance(level), register[0::2]) ^ register[1::2]
        level += 1
    return int(register[0]) ^ 0xFFFFFFFF


@lru_cache(maxsize=1)
def _table() -> UInt32[np.ndarray, " 256"]:
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, (table >> 1) ^ np.uint32(_POLYNOMIAL), table >> 1)
    return table


def _feed(register: UInt32[np.ndarray, " n"], columns: np.ndarray) -> UInt32[np.ndarray, " n"]:
    """The registers after one byte of each column after the other."""
    table = _table()
    for column in columns:
        register = table[(register ^ column) & 0xFF] ^ (register >> 8)
    return register


@lru_cache(maxsize=64)
def _advance(level: int) -> UInt32[np.ndarray, "4 256"]:
    """What ``2 ** level`` blocks of zeros make of each byte of a register."""
    registers = (np.arange(256, dtype=np.uint32) << np.array([[0], [8], [16], [24]], np.uint32)).reshape(-1)
    if level == 0:
        return _feed(registers, np.zeros((_BLOCK, 1), np.uint8)).reshape(4, 256)
    half = _advance(level - 1)
    return _apply(half, _apply(half, registers)).reshape(4, 256)


def _apply(tables: UInt32[np.ndarray, "4 256"], register: UInt32[np.ndarray, " n"]) -> UInt32[np.ndarray, " n"]:
    first, second, third, fourth = (tables[place][(register >> (8 * place)) & 0xFF] for place in range(4))
    return first ^ second ^ third ^ fourth
