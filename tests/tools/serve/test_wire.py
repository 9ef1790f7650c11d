"""Messages with arrays: both ways, byte for byte as openpi packs them, and nothing but numbers from the wire."""

import contextlib
import functools
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.tools.serve.wire import WireError, pack, unpack


def array_map(dtype: Any, data: Any, shape: Any) -> bytes:
    """Packs an array by hand, right or wrong."""
    packed: bytes = msgpack.packb({"x": {b"__ndarray__": True, b"data": data, b"dtype": dtype, b"shape": shape}})
    return packed


def scalar_map(dtype: Any, data: Any) -> bytes:
    packed: bytes = msgpack.packb({"x": {b"__npgeneric__": True, b"data": data, b"dtype": dtype}})
    return packed


@pytest.mark.parametrize("dtype", ["u1", "bool", "<i8", "<f4", ">f8", "<f2"])
def test_arrays_and_scalars_come_back_as_they_were(dtype: str) -> None:
    array = np.arange(12).reshape(3, 4).astype(dtype)
    seen = unpack(pack({"x": array, "one": array[0, 1], "text": "a", "nested": {"y": [array.T]}}))
    np.testing.assert_array_equal(seen["x"], array)
    np.testing.assert_array_equal(seen["nested"]["y"][0], array.T)
    assert seen["x"].dtype == array.dtype and seen["one"] == array[0, 1] and seen["text"] == "a"
    seen["x"][:] = 0  # a copy that may be written


def test_the_bytes_are_those_of_openpis_client() -> None:
    """Its packer (openpi-client 0.1, ``msgpack_numpy.py``) writes these four keys, as bytes, in this order."""

    def packed_by_openpi(value: Any) -> Any:
        return {b"__ndarray__": True, b"data": value.tobytes(), b"dtype": value.dtype.str, b"shape": value.shape}

    message = {"observation/image": np.zeros((2, 3), np.uint8), "prompt": "lift"}
    assert pack(message) == functools.partial(msgpack.packb, default=packed_by_openpi)(message)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "cannot be read"),
        (b"\xc1", "cannot be read"),
        (b"\x91" * 2000, "cannot be read"),
        (msgpack.packb([1, 2]), "whose keys are text"),
        (msgpack.packb({b"x": 1}), "whose keys are text"),
        (array_map("|O", b"\0" * 8, [1]), "the type '|O'"),
        (array_map("|S8", b"\0" * 8, [1]), "the type '|S8'"),
        (array_map("f4,f4", b"\0" * 8, [1]), "the type 'f4,f4'"),
        (array_map([["a", "f4"]], b"\0" * 4, [1]), "the type [['a', 'f4']]"),
        (array_map("<f3", b"\0" * 3, [1]), "which numpy does not know"),
        (array_map("<f4", b"\0" * 4, [2**40]), "the shape"),
        (array_map("<f4", b"\0" * 4, [-1]), "the shape"),
        (array_map("<f4", b"", [0] * 9), "the shape"),
        (array_map("<f4", b"\0" * 4, "ab"), "the shape"),
        (array_map("<f4", b"\0" * 4, [2]), "another number of bytes"),
        (array_map("<f4", "text", [1]), "another number of bytes"),
        (scalar_map("<i8", "7"), "it is a number"),
        (scalar_map("|u1", 700), "does not fit"),
    ],
)
def test_anything_else_is_refused_by_name(data: bytes, said: str) -> None:
    with pytest.raises(WireError) as error:
        unpack(data)
    assert said in str(error.value)


@pytest.mark.parametrize("value", [np.array([object()]), np.array(["a"]), np.array([1j]), {1, 2}, object()])
def test_only_numbers_are_sent(value: Any) -> None:
    with pytest.raises(WireError):
        pack({"x": value})


@given(st.binary(max_size=200))
@settings(max_examples=60)
def test_no_bytes_break_the_reader(data: bytes) -> None:
    with contextlib.suppress(WireError):
        assert isinstance(unpack(data), dict)
