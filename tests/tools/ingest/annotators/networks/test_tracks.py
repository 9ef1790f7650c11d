from dataclasses import replace

import numpy as np
import pytest

from rsjax.tools.ingest.annotators.protocols import AnnotationError
from rsjax.tools.ingest.annotators.tracks import BootsTapir, SpatialTracker
from tests.tools.ingest.annotators.networks.checkouts import check_out
from tests.tools.ingest.videos import ArrayFrames, sliding

torch = pytest.importorskip("torch")
FRAMES = sliding(9, (2, -1), (48, 64))
STEP = np.array([2 / 64, -1 / 48], np.float32)
DEPTH = ArrayFrames(np.ones((9, 48, 64), np.float32) + np.linspace(0, 1, 64, dtype=np.float32))


@pytest.fixture
def spatial(tmp_path):
    torch.save({"shift": torch.tensor([2.0, -1.0])}, tmp_path / "w")
    folder = check_out(tmp_path, "models/spatracker/predictor.py")
    return SpatialTracker(folder, tmp_path / "w", grid=4, span=4, device="cpu")


@pytest.fixture
def tapir(tmp_path):
    torch.save({"shift": torch.tensor([2 * 256 / 64, -256 / 48])}, tmp_path / "w")
    return BootsTapir(check_out(tmp_path, "tapnet/torch/tapir_model.py"), tmp_path / "w", grid=4, span=4)


def test_spatial_trackers_pixels_become_shares_of_the_picture(spatial):
    points = np.array([[0.25, 0.5], [0.5, 0.75]], np.float32)
    places, seen = spatial.follow(FRAMES.pictures, points, DEPTH.pictures)
    np.testing.assert_allclose(places, points[:, None] + np.arange(9)[:, None] * STEP, atol=1e-6)
    assert seen.all() and places.dtype == np.float32


def test_tapirs_rows_and_columns_become_shares_of_the_picture(tapir):
    points = np.array([[0.25, 0.5], [0.5, 0.75]], np.float32)
    places, seen = tapir.follow(FRAMES.pictures, points)
    np.testing.assert_allclose(places, points[:, None] + np.arange(9)[:, None] * STEP, atol=1e-6)
    assert not seen[0, -1]  # not occluded, but far from certain
    assert seen[1].all() and seen[0, :-1].all()


@pytest.mark.parametrize("which", ["spatial", "tapir"])
def test_tracks_go_on_over_spans_until_they_leave(which, request):
    tracked = request.getfixturevalue(which)(FRAMES, DEPTH)
    assert tracked.points.shape[1:] == (9, 2) and tracked.visible[:16, 0].all()
    inside = ((tracked.points >= 0) & (tracked.points < 1)).all(-1)
    assert (inside | ~tracked.visible).all()
    goes_on = tracked.visible[:16].all(1)
    assert goes_on.any()
    moved = tracked.points[:16, 8] - tracked.points[:16, 0]
    np.testing.assert_allclose(moved[goes_on], np.tile(8 * STEP, (goes_on.sum(), 1)), atol=1e-5)


def test_places_that_are_not_finite_are_refused(spatial, tmp_path):
    torch.save({"shift": torch.tensor([float("nan"), 0.0])}, tmp_path / "w2")
    with pytest.raises(AnnotationError, match="not finite"):
        replace(spatial, weights=tmp_path / "w2")(FRAMES, DEPTH)


def test_spatial_tracker_follows_through_fewer_frames_than_its_window(spatial):
    points = np.array([[0.25, 0.5]], np.float32)
    places, seen = spatial.follow(FRAMES.pictures[:2], points, DEPTH.pictures[:2])
    np.testing.assert_allclose(places, points[:, None] + np.arange(2)[:, None] * STEP, atol=1e-6)
    assert seen.all() and places.shape == (1, 2, 2)


@pytest.mark.parametrize("depth", [1.0, 0.0, np.nan])
def test_depth_that_stops_spatial_tracker_is_refused(spatial, depth):
    with pytest.raises(AnnotationError, match="finite and not the same everywhere"):
        spatial(FRAMES, ArrayFrames(np.full((9, 48, 64), depth, np.float32)))
