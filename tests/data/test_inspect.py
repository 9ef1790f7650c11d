from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsjax.data.inspect import contact_sheet, histogram, look, motion_of, render
from rsjax.data.store import StoreError
from tests.data.clips import clip, clip_store


def test_counts_words_and_shapes_are_those_of_the_store(tmp_path: Path) -> None:
    store = clip_store(tmp_path / "a", 0, 7, [1.0, 2.0])
    contents = look(store)
    assert contents.splits == {"train": 7, "test": 2}
    assert contents.words == {
        "task": {"task 0": 4, "task 1": 3, "task 2": 2},
        "difficulty": {"simple": 5, "difficult": 4},
    }
    assert contents.lengths == {4: 9} and contents.depth == (9, 9) and not contents.damaged
    assert contents.shapes["rgb"] == "uint8 (4, 8, 8, 3)"
    np.testing.assert_allclose(contents.motion, 100 * 0.01 * np.sqrt(2), rtol=1e-5)
    assert contents.actions is not None and contents.actions[0] == 3
    told = "\n".join(render(contents))
    assert "train 7, test 2" in told and "'simple' 5×, 'difficult' 4×" in told and "4 frames 9×" in told


def test_only_so_many_records_are_read(tmp_path: Path) -> None:
    contents = look(clip_store(tmp_path / "a"), most=3)
    assert len(contents.motion) == 3 and contents.splits["train"] == 6


def test_motion_counts_only_what_is_seen_twice() -> None:
    record = clip(0, None)
    record["tracks"][0, 2] += 1
    record["visible"][0, 2] = False
    assert motion_of(record) == pytest.approx(np.sqrt(2), rel=1e-5)
    record["visible"][:] = False
    assert motion_of(record) == 0


def test_a_damaged_record_is_told_and_the_others_are_shown(tmp_path: Path) -> None:
    store = clip_store(tmp_path / "a", size=32)
    shard = tmp_path / "a" / "test-00000.array_record"
    payload = bytearray(shard.read_bytes())
    payload[len(payload) // 2 :] = bytes(len(payload) - len(payload) // 2)
    shard.write_bytes(payload)
    contents = look(store)
    assert contents.damaged and "test-00000" in contents.damaged[0]
    assert len(contact_sheet(store)) > 0


@pytest.mark.parametrize("depth_range", [None, [1.0, 2.0]])
def test_the_sheet_shows_the_clips_frames(tmp_path: Path, depth_range: list[float] | None) -> None:
    sheet = contact_sheet(clip_store(tmp_path / "a", depth_range=depth_range), clips=3, frames=2, side=10)
    rows = 3 if depth_range is None else 6
    assert sheet.shape == (rows * 14, 2 * 14, 3) and sheet.dtype == np.uint8
    assert sheet[0, 0].tolist() == [0, 0, 0]
    assert sheet[-14 if depth_range is None else -28, 0].tolist() == [91, 91, 91]


@given(st.lists(st.floats(0, 100)))
def test_a_histogram_is_one_line(values: list[float]) -> None:
    assert "\n" not in histogram(values)
    assert (f"median {np.median(values):.3g}" if values else "not measured") in histogram(values)


def test_a_store_without_a_readable_clip_has_no_sheet(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"no clip can be read"):
        contact_sheet(clip_store(tmp_path / "a"), clips=0)
