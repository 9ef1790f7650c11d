"""Finds keypoints of played frames: follows those of the first frame from frame to frame by Lucas–Kanade.

Axes: K keypoints.
"""

import numpy as np
from jaxtyping import Float32, UInt8

from rsjax.models.roboscape.objective import motion_magnitude
from rsjax.tools.ingest.annotators.tracks import LucasKanade, grid_points
from rsjax.tools.play.session import Session, Start
from rsjax.tools.play.tree import Node

GRID = 6  # points per side, for a first frame without tracks
MOST = 32  # for a family that does not say how many keypoints it learns from

Points = Float32[np.ndarray, "K 3"]  # x and y from 0 to 1, and whether the point is seen


def points_of(session: Session, nodes: list[Node], pane: str) -> Points:
    """Returns the keypoints of the last of these frames, which begin with a branch's first; each frame keeps its own.

    Args:
        pane: "rgb", the model's frames, or "truth", the simulator's, which all these frames must have.
    """
    known = len(nodes) - 1
    while known and pane not in nodes[known].points:
        known -= 1
    if pane not in nodes[known].points:
        assert session.start is not None
        count = session.run.data.config.model.marked_keypoints or MOST
        nodes[known].points[pane] = first_points(session.start, count)
    for before, node in zip(nodes[known:], nodes[known + 1 :], strict=False):
        points = before.points[pane]
        pictures = np.stack([_picture(before, pane), _picture(node, pane)])
        tracks, visible = LucasKanade().follow(pictures, points[:, :2].copy())
        in_sight = visible[:, 1] & (points[:, 2] > 0)  # a lost point stays lost
        places = np.where(in_sight[:, None], tracks[:, 1], points[:, :2])
        node.points[pane] = np.concatenate([places, in_sight[:, None]], axis=1).astype(np.float32)
    found: Points = nodes[-1].points[pane]
    return found


def first_points(start: Start, count: int) -> Points:
    """Returns the first positions of the ``count`` tracks that move most; without tracks, points of a grid."""
    clip = start.clip
    if clip is None or not clip["visible"][:, 0].any():
        places = grid_points(GRID, np.zeros((0, 2), np.float32))
    else:
        motion = np.asarray(motion_magnitude(clip["tracks"], clip["visible"]))
        places = clip["tracks"][np.argsort(-motion, kind="stable")[:count], 0]
    return np.concatenate([places, np.ones((len(places), 1))], axis=1).astype(np.float32)


def _picture(node: Node, pane: str) -> UInt8[np.ndarray, "S S 3"]:
    if pane == "rgb":
        return node.state.rgb
    assert node.truth is not None
    return node.truth.rgb
