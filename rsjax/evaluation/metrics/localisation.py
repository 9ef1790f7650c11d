"""Errors of the places of cube and gripper in the last frame, which a small network trained on true frames reads.

Errors are distances in the image, in widths of the cube. ``…_truth`` is the network's own error on the true frames,
which limits what the other errors can show.
"""

import numpy as np

from rsjax.evaluation.localiser import OBJECTS
from rsjax.evaluation.registry import Located, Scene, Scores, Unavailable, metric


@metric("cube_error_widths", "cube's place", unit="widths", better="lower", statistic="median")
def cube_error(scene: Scene) -> Scores:
    """Returns the distance of the cube's centre from its true place."""
    return _errors(scene, "cube")


@metric("gripper_error_widths", "gripper's place", unit="widths", better="lower", statistic="median")
def gripper_error(scene: Scene) -> Scores:
    """Returns the distance of the point between the fingers from its true place."""
    return _errors(scene, "gripper")


@metric("lifted_accuracy", "lifted or not", better="higher")
def lifted_accuracy(scene: Scene) -> Scores:
    """Returns 1 for each clip where the network reads correctly whether the cube is lifted, otherwise 0."""
    located = _located(scene)
    return {part: (places.lifted == located.truth.lifted).astype(float) for part, places in located.read().items()}


def _errors(scene: Scene, name: str) -> Scores:
    located = _located(scene)
    k = OBJECTS.index(name)
    return {
        part: np.linalg.norm(places.xy - located.truth.xy, axis=-1)[:, k] / located.width
        for part, places in located.read().items()
    }


def _located(scene: Scene) -> Located:
    if scene.located is None:
        raise Unavailable("the clips do not say where cube and gripper are, as the simulator's training clips do")
    return scene.located
