from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsjax.data.store import StoreError, open_store, write_store
from rsjax.data.token_sets import FOLDER, tokens_key
from rsjax.tools.studies.report.contents import describe, histogram, motion_of, sampled
from rsjax.tools.studies.report.depth_view import SCALE, depth_to_colors
from rsjax.tools.studies.report.lettering import lacks_letters
from rsjax.tools.studies.report.sheet import CAPTION, sheet_page, sheet_picture, sheet_rows
from tests.data.clips import clip, clip_store


def test_counts_labels_and_shapes_are_those_of_the_store(tmp_path: Path) -> None:
    lines, damaged = describe(clip_store(tmp_path / "a", 0, 7, [1.0, 2.0]))
    assert not damaged
    assert {
        "splits    train 7, test 2",
        "task      'task 0' 4×, 'task 1' 3×, 'task 2' 2×",
        "difficulty 'simple' 5×, 'difficult' 4×",
        "rgb       uint8 (4, 8, 8, 3)",
        "depth     in 9 of 9 records read",
        "lengths   4 frames 9×",
    } <= {*lines}
    (actions,) = [line for line in lines if "dimensions" in line]
    assert actions.startswith("actions   3 dimensions, ")
    (tracks,) = [line for line in lines if "% of a side per frame" in line]
    assert tracks.startswith("tracks    ") and tracks.endswith("median 1.41")  # 0.01 right and down


def test_only_so_many_records_are_read(tmp_path: Path) -> None:
    lines, _ = describe(clip_store(tmp_path / "a"), most=3)
    assert {"depth     in 0 of 3 records read", "splits    train 6, test 2"} <= {*lines}


def test_motion_counts_only_what_is_seen_twice() -> None:
    record = clip(0, None)
    record["tracks"][0, 2] += 1
    record["visible"][0, 2] = False
    assert motion_of(record) == pytest.approx(np.sqrt(2), rel=1e-5)
    record["visible"][:] = False
    assert motion_of(record) == 0


def test_a_damaged_record_is_reported_and_the_others_are_shown(tmp_path: Path) -> None:
    store = clip_store(tmp_path / "a", size=32)
    shard = tmp_path / "a" / "test-00000.array_record"
    payload = bytearray(shard.read_bytes())
    payload[len(payload) // 2 :] = bytes(len(payload) - len(payload) // 2)
    shard.write_bytes(payload)
    lines, damaged = describe(store)
    assert "test-00000" in damaged[0] and f"damaged   {damaged[0]}" in lines
    assert list(sheet_rows(store))


def test_what_the_manifest_and_the_clips_say_of_their_origin_is_reported(tmp_path: Path) -> None:
    store = clip_store(tmp_path / "a", count=3)
    records = [store.source("train")[number] for number in range(3)]
    for record, motion in zip(records, (1.0, 3.0, 5.0), strict=True):
        record["provenance"] |= {"camera": "front", "fps": 30.0, "frames": [0, 15, 30, 45], "motion": motion}
    windows = {"kept": 3, "still": 7}
    counts = {"without": 1, "quarantined": 2, "windows": windows, "depth_left_out": 0}
    meta = {"action_mean": [0.5, -1.0], "action_std": [1.0, 2.0], "episodes": {"train": ["x", "y"], "test": []}}
    write_store(tmp_path / "b", "clips", {"train": records}, meta | {"key": "b", "counts": counts})
    clip_store(tmp_path / "b" / FOLDER / "abc", count=3, kind="tokens")
    tokens = tmp_path / "b" / FOLDER / "set"
    write_store(tokens, "tokens", {"train": records}, {"key": tokens_key("b", "set")})
    lines, _ = describe(open_store(tmp_path / "b"))
    for line in (
        "tokens    set: train 3",
        "episodes  train 2, test 0",
        "left out  episodes without a clip 1, episodes quarantined 2, windows still 7",
        "cameras   front 3",
        "rate      30 fps, every 15 frames (2 Hz) 3×",
        "mean±std  0.5±1, -1±2",
    ):
        assert line in lines
    assert not any("abc" in line for line in lines)  # tokens of other clips
    named = {"action_dimensions": ["x (delta)", "grip (held)"]}
    write_store(tmp_path / "c", "clips", {"train": records}, meta | named | {"key": "b", "counts": counts})
    lines, _ = describe(open_store(tmp_path / "c"))
    assert {"action 0  x (delta) 0.5±1", "action 1  grip (held) -1±2"} < {*lines}
    (speed,) = [line for line in lines if "px/s of a 256-pixel-wide picture" in line]
    assert speed.startswith("motion    1 ") and " 5 px/s" in speed and speed.endswith("median 3")


def test_a_merged_store_shows_what_was_left_out_of_its_parts(tmp_path: Path) -> None:
    store = clip_store(tmp_path / "a", count=2)
    records = [store.source("train")[0]]
    write_store(
        tmp_path / "b", "clips", {"train": records}, {"filtered": {"x": "still"}, "quarantine": {"y": "", "z": ""}}
    )
    lines, _ = describe(open_store(tmp_path / "b"))
    assert "left out  episodes without a clip 1, episodes quarantined 2" in lines


@pytest.mark.parametrize("depth_range", [None, [1.0, 2.0]])
def test_the_sheet_shows_the_clips_frames(tmp_path: Path, depth_range: list[float] | None) -> None:
    sheet = sheet_picture(list(sheet_rows(clip_store(tmp_path / "a", depth_range=depth_range), 3, 2, 10)))
    height = 14 if depth_range is None else 2 * 14 + SCALE
    assert sheet.shape == (3 * (height + CAPTION), 2 * 14, 3) and sheet.dtype == np.uint8
    assert sheet[CAPTION, 0].tolist() == [0, 0, 0]
    assert sheet[-height, 0].tolist() == [91, 91, 91]
    if depth_range is not None:
        assert sheet[-height + 14, 0].tolist() == depth_to_colors(np.array(1.0), 1.0, 1.001).tolist()


def test_each_row_of_the_sheet_is_captioned_with_its_own_number_and_task(tmp_path: Path) -> None:
    store = clip_store(tmp_path / "a", count=4, depth_range=[1.0, 2.0])
    sheet = sheet_picture(list(sheet_rows(store, clips=6, frames=3)))
    height = len(sheet) // 6
    captions = [sheet[row * height : row * height + CAPTION] for row in range(6)]
    assert len({caption.tobytes() for caption in captions}) == 6 and all(caption.max() > 200 for caption in captions)
    places = [(split, number) for split, number, _ in sampled(store, 6, [])]
    assert places == [("train", 0), ("train", 1), ("train", 2), ("train", 3), ("test", 0), ("test", 1)]
    for split, number, record in sampled(store, 6, []):
        assert record["provenance"]["number"] == number + (90 if split == "test" else 0)


def test_captions_are_drawn_in_a_font_with_their_letters_or_shown_by_a_page() -> None:
    assert not lacks_letters("Fülle den Топf mit ναρό") and lacks_letters("\U0010fffd")
    row = np.zeros((4, 200, 3), np.uint8)
    pictures = [sheet_picture([(text, row)]).tobytes() for text in ("ж", "я", "?")]
    assert len(set(pictures)) == 3
    page = sheet_page([("折る <b>", row), ("fold", row)], "a & b")
    assert "折る &lt;b&gt;" in page and "<title>a &amp; b</title>" in page and page.count("data:image/webp") == 2


@given(st.lists(st.floats(0, 100)))
def test_a_histogram_is_one_line(values: list[float]) -> None:
    text = histogram(values, "px")
    assert "\n" not in text
    assert (f"px, median {np.median(values):.3g}" if values else "not measured") in text


def test_a_store_without_a_readable_clip_has_no_sheet(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match=r"no clip can be read"):
        list(sheet_rows(clip_store(tmp_path / "a"), clips=0))
