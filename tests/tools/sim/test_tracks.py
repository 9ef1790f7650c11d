import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rsjax.tools.sim.expert import Expert, draw_manner
from rsjax.tools.sim.lift import LiftSim
from rsjax.tools.sim.render import Camera
from rsjax.tools.sim.tracks import TOLERANCE, Snapshot, grid_pixels, object_pixels, track, unoccluded

SIZE = 64


@given(st.integers(0, 2**32 - 1), st.floats(20, 90))
def test_unproject_inverts_project(seed: int, fovy: float) -> None:
    rng = np.random.default_rng(seed)
    rotation = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    camera = Camera(rng.standard_normal(3), rotation, fovy)
    xy, depth = rng.uniform(-0.5, 1.5, (8, 2)), rng.uniform(0.1, 3, 8)
    back_xy, back_depth = camera.project(camera.unproject(xy, depth))
    np.testing.assert_allclose(back_xy, xy, atol=1e-9)
    np.testing.assert_allclose(back_depth, depth, atol=1e-9)


def test_projection_by_hand() -> None:
    """Fovy 90° sees as far to each side as it looks ahead; MuJoCo's cameras look along -z."""
    camera = Camera(np.zeros(3), np.eye(3), 90.0)
    points = np.array([[0, 0, -2.0], [2, 0, -2], [0, 2, -2], [-1, -1, -2], [0, 0, 1]])
    xy, depth = camera.project(points)
    np.testing.assert_allclose(xy[:4], [[0.5, 0.5], [1, 0.5], [0.5, 0], [0.25, 0.75]], atol=1e-12)
    np.testing.assert_allclose(depth, [2, 2, 2, 2, -1])


@given(st.integers(1, 5000), st.integers(0, 2**32 - 1))
def test_picked_pixels_are_different_and_favour_what_moves(count: int, seed: int) -> None:
    bodies = np.zeros((SIZE, SIZE), np.int32)
    bodies[30:35, 20:25] = 2
    bodies[:10, 20:50] = 1
    movable = np.array([False, True, True])
    pixels = object_pixels(bodies, movable, 2, count, np.random.default_rng(seed))
    assert pixels.shape == (count, 2)
    assert pixels.min() >= 0
    assert pixels.max() < SIZE
    assert len(np.unique(pixels, axis=0)) == min(count, SIZE**2)
    on = bodies[tuple(pixels.T)]
    if 16 <= count <= 400:
        assert (on > 0).sum() >= 0.45 * count
        assert (on == 2).sum() >= min(25 - 4, count // 5)


@given(st.integers(1, 5000), st.integers(0, 2**32 - 1))
def test_grid_pixels_are_different_and_lie_evenly(count: int, seed: int) -> None:
    pixels = grid_pixels(SIZE, count, np.random.default_rng(seed))
    assert pixels.shape == (count, 2)
    assert pixels.min() >= 0
    assert pixels.max() < SIZE
    assert len(np.unique(pixels, axis=0)) == min(count, SIZE**2)
    quarters = np.bincount((pixels[:, 0] >= SIZE // 2) * 2 + (pixels[:, 1] >= SIZE // 2), minlength=4)
    side = min(int(np.sqrt(count)), SIZE)
    assert quarters.min() >= (side // 2) ** 2


def test_occlusion() -> None:
    depth = np.full((100, 100), 2.0, np.float32)
    depth[:, :50] = 1.0
    xy = np.array([[0.2, 0.5], [0.8, 0.5], [0.8, 1.0], [-0.01, 0.5], [0.8, 0.5], [0.2, 0.5]])
    z = np.array([2.0, 2.0, 2.0, 1.0, -1.0, 1 + TOLERANCE / 2])
    np.testing.assert_array_equal(unoccluded(xy, z, depth), [False, True, False, False, False, True])


@pytest.fixture(scope="module")
def moments(sim: LiftSim):
    """Frames of an episode that lifts the cube: snapshots, views, segmentations, cube poses."""
    rng = np.random.default_rng(4)
    while (manner := draw_manner(rng)).mode != "lift":
        pass
    sim.reset(0)
    expert = Expert(manner, rng)
    result = []
    for step in range(60):
        if step % 6 == 0:
            view = sim.render()
            result.append((Snapshot(sim.camera, *sim.body_poses(), view.fine_depth), view, sim.segment()))
        sim.step(expert.act(sim.state))
    assert sim.success
    return result


def camera_matrix(sim: LiftSim) -> np.ndarray:
    """World (homogeneous) → pixels times depth: K [R | t] from the model's own camera, x right, y down, z ahead."""
    model, data = sim._env.sim.model, sim._env.sim.data
    camera = model.camera_name2id("agentview")
    focal = SIZE / 2 / np.tan(np.radians(model.cam_fovy[camera]) / 2)
    intrinsic = np.array([[focal, 0, SIZE / 2], [0, focal, SIZE / 2], [0, 0, 1]])
    to_camera = np.diag([1, -1, -1]) @ data.cam_xmat[camera].reshape(3, 3).T
    return intrinsic @ np.column_stack([to_camera, -to_camera @ data.cam_xpos[camera]])


def test_a_track_on_the_cube_agrees_with_an_independent_projection(sim: LiftSim, moments) -> None:
    """The visible top face: a point of it placed by hand from the cube's pose, projected with the camera's matrix."""
    matrix = camera_matrix(sim)  # the camera stands still
    snapshots, (_, view, bodies) = [m[0] for m in moments], moments[0]
    offset = np.array([0, 0, sim._model.geom_size[sim._model.body_geomadr[sim.object_bodies[0]]][2]])

    def by_hand(shot: Snapshot, local: np.ndarray) -> np.ndarray:
        world = shot.positions[sim.object_bodies[0]] + shot.rotations[sim.object_bodies[0]] @ local
        x, y, z = matrix @ np.append(world, 1)
        return np.array([x / z, y / z])  # pixels

    start = by_hand(snapshots[0], offset)
    pixel = start.astype(int)[None, ::-1]
    assert bodies[tuple(pixel[0])] == sim.object_bodies[0]
    tracks, visible = track(pixel, view.depth, bodies, snapshots)
    assert visible[0, 0]
    # the tracked point is the pixel's centre: the same face, beside the face's centre by less than a pixel's diagonal
    shift = pixel[0, ::-1] + 0.5 - start
    camera, cube = snapshots[0].camera, snapshots[0].rotations[sim.object_bodies[0]]
    world = camera.unproject((pixel[0, ::-1] + 0.5) / SIZE, view.depth[tuple(pixel[0])].astype(float))
    local = cube.T @ (world - snapshots[0].positions[sim.object_bodies[0]])
    assert local[2] == pytest.approx(offset[2], abs=1e-3), "depth puts the point on the top face"
    assert np.abs(shift).max() <= 0.5
    for t, shot in enumerate(snapshots):
        np.testing.assert_allclose(tracks[0, t] * SIZE, by_hand(shot, local), atol=0.02)
    assert np.linalg.norm(tracks[0, -1] - tracks[0, 0]) * SIZE > 3, "the cube moved"


def test_visible_tracks_lie_on_their_body_and_hidden_ones_do_not(sim: LiftSim, moments) -> None:
    _, view, bodies = moments[0]
    pixels = object_pixels(bodies, sim.movable, sim.object_bodies, 256, np.random.default_rng(0))
    tracks, visible = track(pixels, view.depth, bodies, [m[0] for m in moments])
    assert visible[:, 0].all()
    np.testing.assert_allclose(tracks[:, 0], (pixels[:, ::-1] + 0.5) / SIZE, atol=1e-5)
    body = bodies[tuple(pixels.T)]
    agree: dict[bool, list[bool]] = {True: [], False: []}
    for t, (_, _, seen) in enumerate(moments):
        x, y = tracks[:, t].T
        inside = (x >= 0) & (x < 1) & (y >= 0) & (y < 1)
        same = seen[(y[inside] * SIZE).astype(int), (x[inside] * SIZE).astype(int)] == body[inside]
        for state in (True, False):
            agree[state].extend(same[visible[inside, t] == state])
    assert np.mean(agree[True]) > 0.96  # the others lie within a pixel of an edge
    assert len(agree[False]) > 50
    assert np.mean(agree[False]) < 0.5


def test_pictures_are_upright_and_in_colour(sim: LiftSim, moments) -> None:
    _, view, bodies = moments[0]
    cube = bodies == sim.object_bodies[0]
    red, green, blue = view.rgb[cube].mean(0)
    assert red > 2 * max(green, blue), "RGB order"
    assert np.argwhere(sim.movable[bodies] & ~cube)[:, 0].mean() < np.argwhere(cube)[:, 0].mean(), (
        "the arm comes from above"
    )
    assert view.rgb.shape == (SIZE, SIZE, 3)
    assert view.depth.shape == (SIZE, SIZE)


def test_depth_is_metric(sim: LiftSim, moments) -> None:
    """Unprojected pixels of the table, which is the world's body, lie 0.8 m above the floor."""
    shot, view, bodies = moments[0]
    rows, columns = np.mgrid[40:60, 20:44].reshape(2, -1)
    assert not sim.movable[bodies[rows, columns]].any()
    xy = np.stack([columns + 0.5, rows + 0.5], -1) / SIZE
    points = shot.camera.unproject(xy, view.depth[rows, columns].astype(float))
    np.testing.assert_allclose(points[:, 2], 0.8, atol=2e-3)
