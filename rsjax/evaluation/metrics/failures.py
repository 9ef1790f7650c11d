"""Failure modes of generated video as numbers: ghosts and morphing, each a share from 0 to 1, lower is better.

A ghost is a thing seen through: where something has come or gone in the true clip, the frame shows a mixture of before
and now. Morphing is a thing that changes its look while it moves: points that can be followed through the true clip
are lost in the generated one, or their surroundings change. Both are 0 for the true clip itself, and for a first frame
that is repeated, so they say what is wrong with a moving picture, not whether it moves.

Axes: B clips, P predicted frames, K points, H×W pixels.
"""

from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from rsjax.evaluation.metrics.psnr_motion import moved
from rsjax.evaluation.registry import PerClip, PerFrame, Scene, metric

FLAGGED = {"ghost": 0.25, "morphing": 0.5}  # a clip with a higher share shows the failure
CONTRAST = 60.0  # distance of colours, of 442, from which a mixture of two can be distinguished from either
MIXED = (0.25, 0.75)  # shares of the new colour in a mixture
ASIDE = 0.35  # distance from the line between both colours, relative to its length, up to which a colour is a mixture
POINTS = 32
PATCH = (9, 9)
ALIKE = 0.7  # correlation of a point's surroundings from which they are the same in the true clip
CHANGED = 0.6  # and below which they are others in the generated one

Points = Float32[np.ndarray, "K 2"]


def ghost_frames(scene: Scene) -> PerFrame:
    """Returns the share of mixed pixels of every predicted frame, among those with another colour than at first."""
    last = scene.prompt_frames - 1
    clips = zip(scene.truth.rgb[:, last:], scene.prediction.rgb[:, last:], strict=True)
    return np.stack([mixed_share(truth, prediction) for truth, prediction in clips])  # all at once take gigabytes


def mixed_share(
    truth: UInt8[np.ndarray, "T H W 3"], prediction: UInt8[np.ndarray, "T H W 3"]
) -> Float[np.ndarray, " T-1"]:
    """Returns the share of mixed pixels of a clip's frames after the first one."""
    start = truth[:1].astype(np.float32)
    way = truth[1:] - start
    gone = prediction[1:] - start
    length = np.square(way).sum(-1)
    visible = length >= CONTRAST**2
    share = (gone * way).sum(-1) / np.where(visible, length, 1)
    aside = np.square(gone - share[..., None] * way).sum(-1)
    mixed = visible & (share > MIXED[0]) & (share < MIXED[1]) & (aside < ASIDE**2 * length)
    return mixed.sum((1, 2)) / np.maximum(visible.sum((1, 2)), 1)


@metric("ghost", "ghosts", better="lower", decimals=3, column=False, per_frame=ghost_frames)
def ghost(scene: Scene) -> PerClip:
    """Returns the mean over each clip's predicted frames."""
    return scene.shared(ghost_frames).mean(-1)


@metric("morphing", "morphing", better="lower", decimals=3, column=False)
def morphing(scene: Scene) -> PerClip:
    """Returns the share of each clip's points that are lost or change; 0 without points that can be followed."""
    last = scene.prompt_frames - 1
    scores = []
    for truth, prediction in zip(scene.truth.rgb[:, last:], scene.prediction.rgb[:, last:], strict=True):
        points = moving_points(truth)
        points = points[likeness(truth, points) >= ALIKE]
        changed = likeness(prediction, points) < CHANGED
        scores.append(float(changed.mean()) if len(points) else 0.0)
    return np.array(scores)


def moving_points(frames: UInt8[np.ndarray, "T H W 3"]) -> Points:
    """Returns corners of the first frame where something moves later."""
    where = moved(frames)[-1].astype(np.uint8)
    corners = cv2.goodFeaturesToTrack(
        _grey(frames[0]), POINTS, 0.02, 3, mask=cv2.dilate(where, np.ones((3, 3), np.uint8))
    )
    if corners is None:
        return np.zeros((0, 2), np.float32)
    return corners[:, 0]


def likeness(frames: UInt8[np.ndarray, "T H W 3"], points: Points) -> Float32[np.ndarray, " K"]:
    """Follows points of the first frame by Lucas–Kanade, and compares their surroundings in the first and last frame.

    Returns:
        The correlation of the two patches of grey; -1 for a point that is lost on the way or leaves the picture.
    """
    if not len(points):
        return np.zeros(0, np.float32)
    grey = [_grey(frame) for frame in frames]
    places = points[:, None]
    kept = np.ones(len(points), bool)
    for before, after in pairwise(grey):
        places, status, _ = cv2.calcOpticalFlowPyrLK(before, after, places, places.copy(), winSize=(11, 11), maxLevel=2)
        kept &= status[:, 0] > 0
    size = np.array(grey[0].shape[::-1])
    kept &= ((places[:, 0] >= 0) & (places[:, 0] < size)).all(1)
    first = [cv2.getRectSubPix(grey[0], PATCH, tuple(map(float, point))) for point in points]
    last = [cv2.getRectSubPix(grey[-1], PATCH, tuple(map(float, point))) for point in places[:, 0]]
    scores = [float(cv2.matchTemplate(b, a, cv2.TM_CCOEFF_NORMED)[0, 0]) for a, b in zip(first, last, strict=True)]
    return np.where(kept, np.array(scores, np.float32), np.float32(-1))


def _grey(frame: UInt8[np.ndarray, "H W 3"]) -> UInt8[np.ndarray, "H W"]:
    return np.asarray(cv2.cvtColor(frame, cv2.COLOR_RGB2GRAY))
