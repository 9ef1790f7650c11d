from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from rsjax.models.roboscape.objective import attention_map, motion_magnitude, select, token_cells

GRID = 4
POSITION = st.floats(-0.25, 1.25, width=32)


def random_tracks(seed: int, clips: int = 3, tracks: int = 9, frames: int = 5) -> tuple[Any, Any]:
    rng = np.random.default_rng(seed)
    return rng.uniform(-0.1, 1.1, (clips, tracks, frames, 2)).astype(np.float32), rng.random(
        (clips, tracks, frames)
    ) < 0.6


def plain_magnitude(track: np.ndarray, visible: np.ndarray) -> float:
    total = 0.0
    for t in range(len(track) - 1):
        if visible[t] and visible[t + 1]:
            total += float(np.hypot(*(track[t + 1].astype(np.float64) - track[t])))
    return total


def plain_cell(point: np.ndarray) -> int:
    centres = (np.arange(GRID) + 0.5) / GRID
    distance = (centres[:, None] - point[1]) ** 2 + (centres[None] - point[0]) ** 2  # row, column
    return int(np.argmin(distance))


def test_motion_magnitude_sums_the_visible_steps() -> None:
    tracks, visible = random_tracks(0)
    expected = [[plain_magnitude(*x) for x in zip(*clip, strict=True)] for clip in zip(tracks, visible, strict=True)]
    np.testing.assert_allclose(motion_magnitude(tracks, visible), np.array(expected), rtol=1e-5, atol=1e-6)


@settings(deadline=None)
@given(hnp.arrays(np.float32, 2, elements=POSITION))
def test_no_other_cell_is_nearer(point: np.ndarray) -> None:
    index = int(token_cells(jnp.array(point), GRID))
    row, column = divmod(index, GRID)
    best_row, best_column = divmod(plain_cell(point), GRID)
    here, best = (
        np.hypot((r + 0.5) / GRID - point[1], (c + 0.5) / GRID - point[0])
        for r, c in ((row, column), (best_row, best_column))
    )
    assert here == pytest.approx(best, abs=1e-6)


def test_the_tracks_that_move_most_are_selected() -> None:
    count = 4
    tracks, visible = random_tracks(1)
    selected = select(tracks, visible, count, GRID)
    for clip in range(len(tracks)):
        magnitudes = [plain_magnitude(*x) for x in zip(tracks[clip], visible[clip], strict=True)]
        expected = {
            (tuple(plain_cell(p) for p in tracks[clip, i]), tuple(visible[clip, i]))
            for i in np.argsort(magnitudes)[len(magnitudes) - count :]
        }
        found = {
            (tuple(map(int, cells)), tuple(map(bool, seen)))
            for cells, seen in zip(selected.cells[clip], selected.visible[clip], strict=True)
        }
        assert found == expected


def test_the_attention_map_is_gamma_along_the_visible_tracks() -> None:
    tracks, visible = random_tracks(2)
    selected = select(tracks, visible, 3, GRID)
    expected = np.ones((3, 5, GRID, GRID))
    for clip in range(3):
        for i in range(3):
            for t in range(5):
                if selected.visible[clip, i, t]:
                    row, column = divmod(int(selected.cells[clip, i, t]), GRID)
                    expected[clip, t, row, column] = 7.0
    np.testing.assert_array_equal(attention_map(selected, GRID, 7.0), expected)
    assert set(np.unique(expected)) == {1.0, 7.0}
