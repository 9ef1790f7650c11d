import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsjax.errors import UserError
from rsjax.tools.ingest.episode import EpisodeError, SourceError, fingerprint
from rsjax.tools.ingest.formats import FORMATS, open_source
from rsjax.tools.ingest.formats.files import (
    MAX_CELLS,
    fill,
    inside,
    json_lines,
    load_npy,
    matrix,
    media,
    parquet_columns,
    parquet_rows,
    read_json,
    seconds,
)
from rsjax.tools.ingest.formats.folder import read_table
from rsjax.tools.ingest.formats.hdf5 import open_file
from rsjax.tools.ingest.formats.keymap import key_map
from rsjax.tools.ingest.formats.tfrecord import read_payload, spans

ROOT = Path("/data/set")


@given(st.lists(st.sampled_from(["..", ".", "a", "/", "//", "b.mp4", "\0", ""]), max_size=6).map("".join) | st.text())
def test_no_name_leads_out(name: str) -> None:
    try:
        path = inside(ROOT, name)
    except EpisodeError:
        return
    assert path.is_relative_to(ROOT)
    assert ".." not in path.parts


@given(st.text(alphabet="{}:!.0d3[]ab", max_size=12))
def test_templates_are_filled_or_refused(template: str) -> None:
    try:
        made = fill(template, a=7, b="x")
    except EpisodeError:
        return
    assert len(made) < 200


def test_templates() -> None:
    assert fill("c-{a:03d}/{b}_{a:06d}.mp4", a=7, b="top") == "c-007/top_000007.mp4"
    for template in ("{a.__class__}", "{a!r}", "{a:>9}", "{c}", "{", "{a:0100d}", "{}", "{b:3d}"):
        with pytest.raises(EpisodeError, match="path template"):
            fill(template, a=7, b="top")


def test_bad_lines_do_not_end_the_file(tmp_path: Path) -> None:
    (tmp_path / "f.jsonl").write_bytes(b'{"a": 1}\n\n\xff\n' + b"[" * 100_000 + b"\n[2]")
    (first, one), (third, two), (fourth, deep), (last, three) = json_lines(tmp_path / "f.jsonl")
    assert (first, one, third, fourth, last, three) == (1, {"a": 1}, 3, 4, 5, [2])
    assert isinstance(two, ValueError)
    assert isinstance(deep, ValueError)
    with pytest.raises(SourceError, match="gone: missing"):
        list(json_lines(tmp_path / "gone"))


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("agibot", {"tasks": 327}, "option tasks is 327, should be a list of whole numbers or texts$"),
        ("agibot", {"cameras": "head"}, "option cameras is 'head', should be a list of texts$"),
        ("lerobot", {"held": ["x"]}, r"option held is \['x'\], should be a list of whole numbers$"),
        ("lerobot", {"held": [True]}, r"option held is \[True\], should be a list of whole numbers$"),
        ("lerobot", {"kind": "relative"}, "option kind is 'relative', should be absolute or delta$"),
        ("folder", {"fps": "fast"}, "option fps is 'fast', should be a number$"),
        ("folder", {"after": "yes"}, "option after is 'yes', should be true or false$"),
        ("robomimic", {"depth": 1}, "option depth is 1, should be true or false$"),
        ("rlds", {"split": 1}, "option split is 1, should be text$"),
        ("folder", {"xyz": 3}, "no option 'xyz'; it has task, fps, after, action, kind, held, quaternions"),
    ],
)
def test_options_are_checked(tmp_path: Path, name: str, options: dict[str, Any], message: str) -> None:
    with pytest.raises(SourceError, match=f"^{name}: {message}"):
        open_source(name, tmp_path, **options)


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_can_be_opened(tmp_path: Path, name: str) -> None:
    for options, place, message in (({"nonsense": 1}, "", "no option 'nonsense'"), ({}, "gone", "gone: not there")):
        with pytest.raises(SourceError, match=message):
            open_source(name, tmp_path / place, **options)


def test_columns_of_no_numbers_and_files_that_unpack_to_gigabytes_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "bomb.parquet"
    pq.write_table(pa.table({"action": np.zeros(MAX_CELLS + 1, np.float32)}), path)
    assert path.stat().st_size < 2**20
    values = pa.array(np.zeros(8 * MAX_CELLS // 4 + 2, np.float32))
    wide = pa.table({"action": pa.ListArray.from_arrays(pa.array([0, len(values)], pa.int32()), values)})
    table = pa.table({"pair": [[1.0, 2.0]] * 4, "text": ["1"] * 4})
    refused: dict[str, Callable[[], object]] = {
        "f: column 'pair' has 2 numbers a row": lambda: seconds(table, "pair", "f"),
        r"f: column 'text' \(string\) is not rows of as many numbers": lambda: matrix(table, "text", "f"),
        r"bomb.parquet: 16777217 rows of \d+ bytes, more than a table": lambda: parquet_columns(path),
        r"f: column 'action' has \d+ bytes, more than it can have": lambda: matrix(wide, "action", "f"),
    }
    for message, read in refused.items():
        with pytest.raises(EpisodeError, match=message):
            read()


@pytest.mark.parametrize(
    "read",
    [
        read_json,
        load_npy,
        parquet_columns,
        lambda path: list(json_lines(path)),
        lambda path: list(parquet_rows(path, ["x"])),
        lambda path: read_payload(path, 0, 8),
        lambda path: list(spans(path)),
        lambda path: open_file(path).__enter__(),
        lambda path: key_map(str(path), "", path),
        read_table,
        media,
    ],
)
@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_pipes_and_devices_are_refused_where_they_would_never_end(tmp_path: Path, read: Any, kind: str) -> None:
    path = tmp_path / "data.json"
    if kind == "pipe":
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero")
    with pytest.raises(UserError, match=r"data.json: .*a pipe or device, not a file"):
        read(path)
    assert fingerprint([path]) == fingerprint([path])
