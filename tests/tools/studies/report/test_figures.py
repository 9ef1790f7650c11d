import numpy as np
import pytest

from rsjax.tools.studies.report.depth_view import SCALE, depth_to_colors
from rsjax.tools.studies.report.figures import animation, filmstrip, filmstrip_cell, keypoints
from rsjax.tools.studies.report.video import resize


def test_filmstrip_cells_are_the_frames(make_clip):
    clip = make_clip(frames=16)
    sheet = filmstrip(clip)
    times = [0, 2, 4, 6, 9, 11, 13, 15]
    rows = clip.rows()
    assert [label.split("\n")[0] for label, _ in rows] == [
        "truth",
        "prediction",
        "prediction with",
        "tokenizer's",
        "true depth",
        "predicted depth",
    ]
    for i, (_, frames) in enumerate(rows):
        for j, t in enumerate(times):
            y, x = filmstrip_cell(clip, i, j)
            np.testing.assert_array_equal(sheet[y : y + 128, x : x + 128], resize(frames[t : t + 1], 4)[0])
    height, width = filmstrip_cell(clip, 6, 8)
    assert sheet.shape[:2] == (height + SCALE + 6, width)
    near, far = depth_to_colors(np.array(clip.depth_range()), *clip.depth_range())
    scale = sheet[height + 6 + 4]
    first = filmstrip_cell(clip, 0, 0)[1]
    np.testing.assert_array_equal(scale[[first, width - 7]], [near, far])


def test_a_short_clip_shows_each_frame_once(make_clip):
    clip = make_clip(frames=3)
    assert filmstrip(clip).shape[1] == filmstrip_cell(clip, 0, 3)[1]


def test_animation_has_every_frame_and_row(make_clip):
    clip = make_clip()
    sheets = animation(clip)
    assert len(sheets) == 6
    for t in range(6):
        for i, (_, frames) in enumerate(clip.rows()):
            x = 6 + i * (192 + 6)
            np.testing.assert_array_equal(sheets[t, 46 : 46 + 192, x : x + 192], resize(frames[t : t + 1], 6)[0])
    x = 6 + 4 * (192 + 6)
    bar = sheets[:, 46 + 192 + 6 + 4, [x, x + 2 * 192 + 5]]
    np.testing.assert_array_equal(bar[0], depth_to_colors(np.array([1.0, 2.0]), 1.0, 2.0))
    assert (bar == bar[0]).all()


def test_prompt_frames_and_depths_without_a_unit_are_labelled(make_clip):
    clip = make_clip()
    second = filmstrip_cell(clip, 0, 1)
    below = filmstrip_cell(clip, len(clip.rows()), 0)[0]
    plain = filmstrip(clip)
    rows, columns = np.nonzero((filmstrip(make_clip(prompt_frames=2)) != plain).any(-1))
    assert rows.max() < second[0]
    assert second[1] <= columns.min() < columns.max() < filmstrip_cell(clip, 0, 2)[1]
    rows, _ = np.nonzero((filmstrip(make_clip(depth_unit="relative")) != plain).any(-1))
    assert rows.min() >= below
    changed = (np.asarray(animation(make_clip(prompt_frames=2))) != np.asarray(animation(clip))).any((1, 2, 3))
    assert changed.tolist() == [False, True, False, False, False, False]


def test_missing_rows_are_left_out(make_clip):
    bare = make_clip(reconstruction=None, other_actions=None, true_depth=None, predicted_depth=None)
    assert [label for label, _ in bare.rows()] == ["truth", "prediction"]
    assert filmstrip(bare).shape[0] < filmstrip(make_clip()).shape[0]
    with pytest.raises(ValueError, match="has no depth"):
        bare.depth_range()


def test_both_depths_share_the_true_range(make_clip):
    clip = make_clip()
    assert clip.depth_range() == (1.0, 2.0)
    unknown = make_clip(true_depth=np.where(clip.true_depth == 1, 0, clip.true_depth))
    assert unknown.depth_range()[0] == 2.0
    assert dict(unknown.rows())["true depth"][0, 10, 6].tolist() == [0, 0, 0]
    rows = dict(clip.rows())
    np.testing.assert_array_equal(rows["predicted depth"][0, 0, 0], rows["true depth"][0, 0, 0])  # both beyond far
    assert (rows["predicted depth"][0, 10, 6] != rows["true depth"][0, 10, 6]).any()


def test_keypoints_draw_trails_only_where_visible(make_clip):
    seen = np.ones((8, 6), bool)
    hidden = seen.copy()
    hidden[0, 3:] = False
    full, half = keypoints(make_clip(visible=seen)), keypoints(make_clip(visible=hidden))
    plain = keypoints(make_clip(selected=np.array([], int)))
    scale = full.shape[0] // 32
    y = 8 * scale
    near, far = (8 + 1) * scale, round((8 + 4) * scale)  # where the moving point is after 1 and after 4 steps
    assert (full[y, near] != plain[y, near]).any()
    assert (half[y, near] != plain[y, near]).any()
    assert (full[y, far] != plain[y, far]).any()
    np.testing.assert_array_equal(half[y, far], plain[y, far])
    with pytest.raises(ValueError, match="no tracks"):
        keypoints(make_clip(tracks=None))


def test_errors_name_arrays_of_the_wrong_shape(make_clip):
    one_frame = np.zeros((1, 32, 32, 3), np.uint8)
    for changes, message in (
        ({"prediction": one_frame}, r"prediction of clip 'episode <7>' has shape \(1, 32, 32, 3\)"),
        ({"true_depth": np.zeros((6, 32, 32, 1), np.float32)}, "true_depth"),
        ({"visible": None}, "visible"),
    ):
        with pytest.raises(ValueError, match=message):
            make_clip(**changes)
