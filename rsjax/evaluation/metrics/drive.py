"""Free drives: where the gripper is, and PSNR, frame by frame under actions like a person's.

``…_truth`` is the error of the network that reads the gripper's place, on the simulator's own frames.
"""

import numpy as np
from jaxtyping import Float

from rsjax.evaluation.metrics.psnr import psnr
from rsjax.evaluation.registry import Drives, PerFrame, Scene, Scores, Unavailable, metric
from rsjax.evaluation.results import Curves

AXIS = "drive_frame"
FRAME = 48  # the frame at which the gripper's error is the score; the first frame is 1


def axis(scene: Scene) -> Curves:
    """Returns the numbers of the predicted frames, over which the curves run; empty without drives."""
    try:
        frames = scene.drives.truth.rgb.shape[1]
    except Unavailable:
        return {}
    return {AXIS: list(range(scene.prompt_frames + 1, frames + 1))}


def errors_per_frame(scene: Scene) -> PerFrame:
    """Returns the distance of the gripper from its true place in every predicted frame, in widths of the cube."""
    drives = scene.drives
    return _errors(drives, drives.located)[:, scene.prompt_frames :]


@metric(
    "drive_gripper_error_widths",
    f"gripper's place in frame {FRAME} of a drive",
    unit="widths",
    better="lower",
    statistic="median",
    axis=AXIS,
    per_frame=errors_per_frame,
)
def gripper_error(scene: Scene) -> Scores:
    """Returns the error in frame 48."""
    drives = scene.drives
    if drives.gripper.shape[1] < FRAME:
        raise Unavailable(f"the drives have {drives.gripper.shape[1]} frames, not {FRAME}")
    scores: dict[str, Float[np.ndarray, " D"] | float] = {"": _errors(drives, drives.located)[:, FRAME - 1]}
    if drives.on_truth is not None:
        scores["_truth"] = _errors(drives, drives.on_truth)[:, FRAME - 1]
    return scores


def psnr_per_frame(scene: Scene) -> PerFrame:
    """Scores every predicted frame."""
    drives = scene.drives
    return np.asarray(psnr(drives.truth.rgb, drives.prediction.rgb))[:, scene.prompt_frames :]


@metric("drive_psnr", "PSNR of drives", unit="dB", better="higher", decimals=2, axis=AXIS, per_frame=psnr_per_frame)
def drive_psnr(scene: Scene) -> Scores:
    """Returns the mean over each drive's predicted frames."""
    return scene.shared(psnr_per_frame).mean(-1)


@metric("drive_worse_frames", "frames of drives worse than the first repeated", better="lower", column=False)
def worse_frames(scene: Scene) -> Scores:
    """Returns the share of each drive's predicted frames whose PSNR is below that of the last prompt frame repeated."""
    first = scene.prompt_frames
    truth = scene.drives.truth.rgb
    still = psnr(truth, np.broadcast_to(truth[:, first - 1 : first], truth.shape))
    worse: Scores = (scene.shared(psnr_per_frame) < np.asarray(still)[:, first:]).mean(-1)
    return worse


def _errors(drives: Drives, places: Float[np.ndarray, "D T 2"]) -> Float[np.ndarray, "D T"]:
    return np.linalg.norm(places - drives.gripper, axis=-1) / drives.width[:, None]
