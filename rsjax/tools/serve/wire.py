"""Messages with numpy arrays, packed as openpi's ``msgpack_numpy`` packs them, so that each side reads the other's.

An array is a map of ``b"__ndarray__"``, ``b"data"``, ``b"dtype"`` and ``b"shape"``; a numpy scalar is one of
``b"__npgeneric__"``, ``b"data"`` and ``b"dtype"``. Only truth values, integers and floats are read: no objects, so that
nothing in a message is ever executed.
"""

import math
import re
from typing import Any

import msgpack
import numpy as np

from rsjax.errors import UserError

DTYPE = re.compile(r"[<>|=]?[biuf]\d{1,2}")
MOST_AXES = 8


class WireError(UserError):
    """A message that is not what the other side should send. The text says what is wrong."""


def pack(message: dict[str, Any]) -> bytes:
    """Packs a message.

    Raises:
        WireError: it has an array of objects, or something else that cannot be sent.
    """
    try:
        packed: bytes = msgpack.packb(message, default=pack_array)
    except (TypeError, ValueError, OverflowError) as error:
        raise WireError(f"this message cannot be sent: {error}") from error
    return packed


def unpack(data: bytes) -> dict[str, Any]:
    """Reads a message; its arrays are copies that may be written.

    Raises:
        WireError: it is not a map in msgpack, or has an array of another type than truth values, integers and floats.
    """
    try:
        message = msgpack.unpackb(data, object_hook=unpack_array)
    except (ValueError, TypeError, msgpack.UnpackException) as error:
        raise WireError(
            f"a message is a map in msgpack; this one cannot be read ({error or 'it ends too early'})"
        ) from error
    if not isinstance(message, dict) or not all(isinstance(name, str) for name in message):
        raise WireError("a message is a map in msgpack whose keys are text")
    return message


def pack_array(value: Any) -> Any:
    """Returns an array or a numpy scalar as a map; msgpack calls it for what it does not know."""
    if not isinstance(value, np.ndarray | np.generic):
        raise TypeError(f"{type(value).__name__} is neither an array nor plain data")
    if not DTYPE.fullmatch(value.dtype.str):
        raise TypeError(f"an array of {value.dtype}; send truth values, integers or floats")
    if isinstance(value, np.ndarray):
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}
    return {b"__npgeneric__": True, b"data": value.item(), b"dtype": value.dtype.str}


def unpack_array(value: dict[Any, Any]) -> Any:
    """Returns the array or the scalar that a map stands for, or the map itself; msgpack calls it for every map."""
    if b"__ndarray__" in value:
        data: Any = value.get(b"data")
        shape: Any = value.get(b"shape")
        axes_fit = isinstance(shape, list | tuple) and len(shape) <= MOST_AXES
        if not axes_fit or not all(type(side) is int and 0 <= side < 2**31 for side in shape):
            raise WireError(f"an array has the shape {shape!r:.60}; it is a list of at most {MOST_AXES} whole numbers")
        dtype = _dtype(value)
        if not isinstance(data, bytes) or len(data) != math.prod(shape) * dtype.itemsize:
            raise WireError(f"an array of shape {tuple(shape)} and type {dtype} has another number of bytes")
        return np.frombuffer(data, dtype).reshape(shape).copy()
    if b"__npgeneric__" in value:
        number = value.get(b"data")
        if not isinstance(number, bool | int | float):
            raise WireError(f"a scalar has {type(number).__name__} as its data; it is a number")
        try:
            return _dtype(value).type(number)
        except OverflowError as error:
            raise WireError(f"{number} does not fit into {_dtype(value)}") from error
    return value


def _dtype(value: dict[Any, Any]) -> np.dtype[Any]:
    name = value.get(b"dtype")
    if not isinstance(name, str) or not DTYPE.fullmatch(name):
        raise WireError(f"an array has the type {name!r:.40}; it is of truth values, integers or floats, such as '<f4'")
    try:
        return np.dtype(name)
    except TypeError as error:
        raise WireError(f"an array has the type {name!r}, which numpy does not know") from error
