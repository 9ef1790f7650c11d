"""Errors of what the state heads read while the model generates: success, the object's height, the gripper's opening.

The labels are the simulator's, of the same frames under the same actions: a mistake may be the model's or the heads'.
"""

import numpy as np
from jaxtyping import Float

from rsjax.data.state_labels import STATE
from rsjax.evaluation.registry import PerFrame, Scene, Scores, Unavailable, metric

CENTIMETRES = 100.0  # in a metre


def success_frames(scene: Scene) -> PerFrame:
    """Returns 1 for each predicted frame in which the head is right about success, otherwise 0."""
    read, label = scene.shared(_pair, "success")
    return np.where(np.isnan(label), np.nan, (read > 0.5) == (label > 0.5))


def height_frames(scene: Scene) -> PerFrame:
    """Returns the error of the object's height in every predicted frame."""
    read, label = scene.shared(_pair, "height")
    return CENTIMETRES * np.abs(read - label)


def opening_frames(scene: Scene) -> PerFrame:
    """Returns the error of the gripper's opening in every predicted frame."""
    read, label = scene.shared(_pair, "opening")
    return CENTIMETRES * np.abs(read - label)


@metric("state_success_accuracy", "success read", better="higher", column=False, per_frame=success_frames)
def success(scene: Scene) -> Scores:
    """Returns the share of predicted frames in which the head is right, and as ``_brier`` its squared error."""
    read, label = scene.shared(_pair, "success")
    return {"": _means(scene.shared(success_frames)), "_brier": _means(np.square(read - label))}


@metric(
    "state_height_error", "height read", unit="cm", better="lower", decimals=2, column=False, per_frame=height_frames
)
def height(scene: Scene) -> Scores:
    """Returns the mean error of the object's height."""
    return _means(scene.shared(height_frames))


@metric(
    "state_opening_error", "opening read", unit="cm", better="lower", decimals=2, column=False, per_frame=opening_frames
)
def opening(scene: Scene) -> Scores:
    """Returns the mean error of the gripper's opening."""
    return _means(scene.shared(opening_frames))


def _pair(scene: Scene, name: str) -> tuple[PerFrame, PerFrame]:
    """Returns what the head read in the predicted frames, and the labels; NaN where one of them is unknown."""
    if scene.prediction.state is None:
        raise Unavailable("the model has no state heads (model.state_heads)")
    label = scene.truth.state
    column = STATE.index(name)
    if label is None or np.isnan(label[:, scene.prompt_frames :, column]).all():
        raise Unavailable(f"the clips have no label of {name}, as the simulator's do")
    frames = slice(scene.prompt_frames, None)
    return scene.prediction.state[:, frames, column], label[:, frames, column]


def _means(frames: PerFrame) -> Float[np.ndarray, " B"]:
    """Returns each clip's mean over its frames that have a score, without clips that have none."""
    known = np.isfinite(frames)
    labelled = known.any(axis=1)
    return np.where(known, frames, 0).sum(1)[labelled] / known.sum(1)[labelled]
