import contextlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rsjax.tools.ingest.episode import EpisodeError
from rsjax.tools.ingest.formats.tfrecord import Example, masked_crc, read_payload, spans
from tests.tools.ingest.formats.toy_tfrecord import example, write_records

PAYLOADS = [b"first", b"", bytes(range(256)) * 5]


@pytest.mark.parametrize(("data", "crc"), [(b"123456789", 0xE3069283), (bytes(32), 0x8A9136AA), (b"", 0)])
def test_published_checksums_are_masked(data: bytes, crc: int) -> None:
    assert masked_crc(data) == (((crc >> 15) | (crc << 17)) + 0xA282EAD8) % 2**32


def test_records_come_back_by_their_spans(tmp_path: Path) -> None:
    path = write_records(tmp_path / "a.tfrecord", PAYLOADS)
    found = list(spans(path))
    assert [read_payload(path, offset, length) for offset, length, _ in found] == PAYLOADS


def spans_and_damage(path: Path) -> tuple[list[tuple[int, int, int]], str]:
    found: list[tuple[int, int, int]] = []
    try:
        found.extend(spans(path))
    except EpisodeError as error:
        return found, str(error)
    return found, ""


@settings(max_examples=30)
@given(st.data())
def test_a_truncated_file_keeps_what_is_before_the_cut(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    path = write_records(tmp_path_factory.mktemp("cut") / "a.tfrecord", PAYLOADS)
    whole = path.read_bytes()
    kept = list(spans(path))
    cut = data.draw(st.integers(1, len(whole) - 1))
    path.write_bytes(whole[:cut])
    complete = [span for span in kept if span[0] + 16 + span[1] <= cut]
    found, damage = spans_and_damage(path)
    assert found == complete
    assert damage == "" if cut in [offset for offset, _, _ in kept] else "truncated" in damage


@settings(max_examples=30)
@given(st.data())
def test_no_changed_byte_goes_unnoticed(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    path = write_records(tmp_path_factory.mktemp("flip") / "a.tfrecord", PAYLOADS)
    whole = bytearray(path.read_bytes())
    whole[data.draw(st.integers(0, len(whole) - 1))] ^= data.draw(st.integers(1, 255))
    path.write_bytes(whole)
    with pytest.raises(EpisodeError):
        [read_payload(path, offset, length) for offset, length, _ in spans(path)]


def test_an_example_has_its_features() -> None:
    parsed = Example(example({"x": np.arange(6.0), "n": [1, 2], "text": [b"a", b"b"]}), "here")
    np.testing.assert_array_equal(parsed.numbers("x", 3), [[0, 1], [2, 3], [4, 5]])
    np.testing.assert_array_equal(parsed.numbers("n", 2), [[1], [2]])
    assert parsed.blobs("text") == [b"a", b"b"]
    assert parsed.plain("text") == ["a", "b"] and parsed.names() == ["n", "text", "x"]


@pytest.mark.parametrize(
    ("name", "rows", "message"), [("y", 3, "has no y"), ("x", 4, "6 values for 4"), ("text", 1, "bytes")]
)
def test_a_feature_that_does_not_fit_is_named(name: str, rows: int, message: str) -> None:
    parsed = Example(example({"x": np.arange(6.0), "text": [b"a"]}), "here")
    with pytest.raises(EpisodeError, match=f"^here: .*{message}"):
        parsed.numbers(name, rows)


def test_other_bytes_are_no_example() -> None:
    with pytest.raises(EpisodeError, match=r"^here: no tf.train.Example"):
        Example(b"\xff\xff\xff", "here")


@given(st.binary(max_size=60))
def test_any_bytes_are_an_example_or_one_clear_error(payload: bytes) -> None:
    with contextlib.suppress(EpisodeError):
        assert all(isinstance(name, str) for name in Example(payload, "here").names())
