"""Exact keypoint tracks from the simulator: pixels of frame 0 that move with the bodies on which they lie.

A pixel of frame 0 is unprojected with its depth, tied to the body that the segmentation names, moved with that body's
pose, and projected again; it is visible where the depth buffer has nothing nearer.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int32

from rsjax.tools.sim.render import Camera

TOLERANCE = 0.005  # metres that the depth buffer may be nearer than a visible point


@dataclass(frozen=True)
class Snapshot:
    """Camera, body poses in the world (metres) and depth (metres) of one frame."""

    camera: Camera
    positions: Float[np.ndarray, "bodies 3"]
    rotations: Float[np.ndarray, "bodies 3 3"]
    fine_depth: Float32[np.ndarray, "R R"]


def grid_pixels(size: int, count: int, rng: np.random.Generator) -> Int[np.ndarray, "count 2"]:
    """Returns (row, column) of N₀ pixels of frame 0 to track, evenly over the image (paper §2.3).

    They form the largest square grid that N₀ allows. The remaining ones are random, and distinct as long as the image
    has enough pixels.

    Args:
        size: pixels along each side of the image.
        count: N₀.
        rng: generator of the random pixels.
    """
    return _unravel(_fill(_grid(size, count), count, size, rng), size)


def object_pixels(
    bodies: Int32[np.ndarray, "S S"],
    movable: Bool[np.ndarray, " bodies"],
    objects: Int32[np.ndarray, " O"] | int,
    count: int,
    rng: np.random.Generator,
) -> Int[np.ndarray, "count 2"]:
    """Returns (row, column) of N₀ pixels of frame 0 to track, many of them on bodies that can move.

    Up to half lie on a regular grid over the image. Of the others, up to half lie on the objects and the remaining ones
    on movable links of the arm, as far as these cover enough pixels; the rest lie anywhere.

    Args:
        bodies: body id at each pixel.
        movable: whether each body can move.
        objects: the objects' body ids.
        count: N₀.
        rng: generator of the choice.
    """
    size = bodies.shape[0]
    flat = bodies.ravel()
    chosen = _grid(size, count // 2)
    free = np.setdiff1d(np.arange(flat.size), chosen)
    there = np.isin(flat[free], objects)
    on_objects = free[there]
    on_arm = free[movable[flat[free]] & ~there]
    for pool, most in ((on_objects, (count - chosen.size) // 2), (on_arm, count)):
        take = min(most, count - chosen.size, pool.size)
        chosen = np.concatenate([chosen, rng.choice(pool, take, replace=False)])
    return _unravel(_fill(chosen, count, size, rng), size)


def _grid(size: int, most: int) -> Int[np.ndarray, " N"]:
    """Returns the flat indices of the largest square grid of at most ``most`` pixels."""
    side = min(int(np.sqrt(most)), size)
    if side:
        ticks = ((np.arange(side) + 0.5) * size / side).astype(int)
    else:
        ticks = np.zeros(0, int)
    return (ticks[:, None] * size + ticks[None, :]).ravel()


def _fill(chosen: Int[np.ndarray, " N"], count: int, size: int, rng: np.random.Generator) -> Int[np.ndarray, " count"]:
    """Adds random pixels up to ``count``, distinct ones until the image has no more."""
    rest = np.setdiff1d(np.arange(size * size), chosen)
    chosen = np.concatenate([chosen, rng.choice(rest, min(count - chosen.size, rest.size), replace=False)])
    return np.concatenate([chosen, rng.choice(size * size, count - chosen.size)])


def _unravel(flat: Int[np.ndarray, " N"], size: int) -> Int[np.ndarray, "N 2"]:
    return np.stack(np.divmod(flat, size), -1)


def track(
    pixels: Int[np.ndarray, "N 2"],
    depth: Float32[np.ndarray, "S S"],
    bodies: Int32[np.ndarray, "S S"],
    snapshots: Sequence[Snapshot],
) -> tuple[Float32[np.ndarray, "N T 2"], Bool[np.ndarray, "N T"]]:
    """Tracks pixels of frame 0 through a clip.

    Args:
        pixels: (row, column) in frame 0.
        depth: depth of frame 0 in metres.
        bodies: body id at each pixel of frame 0.
        snapshots: one per frame, frame 0 first.

    Returns:
        Tracks and visibility as :class:`rsjax.clip.Clip` defines them.
    """
    rows, columns = pixels.T
    xy = (pixels[:, ::-1] + 0.5) / depth.shape[0]
    first = snapshots[0]
    body = bodies[rows, columns]
    world = first.camera.unproject(xy, depth[rows, columns].astype(np.float64))
    local = np.einsum("nij,ni->nj", first.rotations[body], world - first.positions[body])
    tracks = []
    visible = []
    for shot in snapshots:
        world = shot.positions[body] + np.einsum("nij,nj->ni", shot.rotations[body], local)
        xy, z = shot.camera.project(world)
        tracks.append(xy)
        visible.append(unoccluded(xy, z, shot.fine_depth))
    return np.stack(tracks, 1).astype(np.float32), np.stack(visible, 1)


def unoccluded(
    xy: Float[np.ndarray, "N 2"], z: Float[np.ndarray, " N"], fine_depth: Float32[np.ndarray, "R R"]
) -> Bool[np.ndarray, " N"]:
    """Returns whether each point is inside the image with nothing more than ``TOLERANCE`` nearer than it.

    The buffer's farthest value in the 3×3 around the point counts, so that steep surfaces don't hide themselves.
    """
    size = fine_depth.shape[0]
    inside = (z > 0) & ((xy >= 0) & (xy < 1)).all(-1)
    column, row = (np.where(inside[:, None], xy, 0) * size).astype(int).T
    padded = np.pad(fine_depth, 1, mode="edge")
    around = np.stack([padded[row + i, column + j] for i in range(3) for j in range(3)])
    return inside & (z <= around.max(0) + TOLERANCE)
