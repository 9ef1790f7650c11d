"""Cross-entropy and accuracy of each frame's tokens, predicted from the true frames before it (as 1xgpt reports them).

The whole predicted frame is masked. Both scores compare only models that share a tokenizer.
"""

import numpy as np
from jaxtyping import Float

from rsjax.evaluation.registry import PerFrame, Scene, Scores, Unavailable, metric
from rsjax.models.base import TeacherForced


def cross_entropy_frames(scene: Scene) -> PerFrame:
    """Returns the RGB tokens' cross-entropy in every predicted frame."""
    return _result(scene).cross_entropy["rgb"]


def accuracy_frames(scene: Scene) -> PerFrame:
    """Returns the share of RGB tokens that are right in every predicted frame."""
    return _result(scene).accuracy["rgb"]


@metric(
    "token_cross_entropy",
    "token cross-entropy",
    unit="nats",
    better="lower",
    column=False,
    per_frame=cross_entropy_frames,
)
def cross_entropy(scene: Scene) -> Scores:
    """Returns the cross-entropy, summed over vocabularies, of RGB tokens and, as ``_depth``, of depth tokens."""
    return _by_branch(_result(scene).cross_entropy)


@metric("token_accuracy", "token accuracy", better="higher", decimals=4, column=False, per_frame=accuracy_frames)
def accuracy(scene: Scene) -> Scores:
    """Returns the share of cells whose most probable token is right, for RGB and, as ``_depth``, for depth."""
    return _by_branch(_result(scene).accuracy)


def _by_branch(scores: dict[str, Float[np.ndarray, "B P"]]) -> Scores:
    means = {branch: frames.mean(1) for branch, frames in scores.items()}
    known = {branch: clips[np.isfinite(clips)] for branch, clips in means.items()}
    return {"" if branch == "rgb" else f"_{branch}": clips for branch, clips in known.items() if len(clips)}


def _result(scene: Scene) -> TeacherForced:
    if scene.teacher_forced is None:
        raise Unavailable("this family of models predicts no tokens from true frames")
    return scene.teacher_forced
