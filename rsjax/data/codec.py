"""Encodes records (dicts of arrays and JSON-ready values) as bytes: a checksum, then msgpack, never pickle."""

import zlib
from typing import Any

import msgpack
import numpy as np

Record = dict[str, Any]


def encode(record: Record) -> bytes:
    """Returns a record's payload: CRC-32, then msgpack of its arrays (dtype, shape, bytes) and of its other values."""
    arrays = {
        name: (value.dtype.str, value.shape, np.ascontiguousarray(value).tobytes())
        for name, value in record.items()
        if isinstance(value, np.ndarray)
    }
    values = {name: value for name, value in record.items() if name not in arrays}
    body = msgpack.packb((arrays, values), unicode_errors="surrogatepass")
    return zlib.crc32(body).to_bytes(4, "little") + body


def decode(payload: bytes) -> Record:
    """Inverts :func:`encode`.

    Raises:
        ValueError: the payload is damaged.
    """
    if len(payload) < 4 or zlib.crc32(payload[4:]) != int.from_bytes(payload[:4], "little"):
        raise ValueError("its checksum is wrong")
    arrays, values = msgpack.unpackb(payload[4:], strict_map_key=False, unicode_errors="surrogatepass")
    return values | {
        name: np.frombuffer(raw, np.dtype(dtype)).reshape(shape).copy() for name, (dtype, shape, raw) in arrays.items()
    }
