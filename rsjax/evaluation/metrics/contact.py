"""Grasps at set offsets between fingers and cube: does a model lift the cube where the simulator does, and only there?

The same network that finds cube and gripper reads from the last frame whether the cube is lifted. ``…_truth`` scores
what it reads from the simulator's own last frames, which limits what the other scores can show.
"""

import numpy as np

from rsjax.evaluation.registry import Scene, Scores, Unavailable, metric
from rsjax.evaluation.results import Curves
from rsjax.evaluation.statistics import wilson

AXIS = "contact_offset_cm"  # entries of curves.json
SIMULATOR = "contact_simulator"
MODEL = "contact_model"
LIFTED = 0.5  # probability above which a grasp counts as a success


@metric("contact_false_success", "lifted where the simulator fails", better="lower")
def false_success(scene: Scene) -> Scores:
    """Returns 1 for each grasp that fails in the simulator and succeeds in the scene, 0 for the others that fail."""
    return _wrong(scene, success=False)


@metric("contact_false_failure", "not lifted where the simulator succeeds", better="lower")
def false_failure(scene: Scene) -> Scores:
    """Returns 1 for each grasp that succeeds in the simulator and fails in the scene, 0 for the others that succeed."""
    return _wrong(scene, success=True)


@metric("contact_brier", "Brier score of grasps", better="lower")
def brier(scene: Scene) -> Scores:
    """Returns (p - y)², where p is the probability of success read from the scene, and y is 1 for a true success."""
    grasps = scene.grasps
    return {part: np.square(p - grasps.success) for part, p in grasps.read().items()}


@metric("contact_judge_accuracy", "success read right in true frames of the grasps", better="higher", column=False)
def judge_accuracy(scene: Scene) -> Scores:
    """Returns 1 for each grasp whose success is read right from the simulator's own last frame, otherwise 0."""
    grasps = scene.grasps
    if grasps.on_truth is None:
        raise Unavailable("a baseline has no frames of the simulator")
    return ((grasps.on_truth > LIFTED) == grasps.success).astype(float)


def success_curves(scene: Scene) -> Curves:
    """Returns the shares of grasps that succeed at each offset, in the simulator and in the model, with intervals.

    Empty without grasps.
    """
    try:
        grasps = scene.grasps
    except Unavailable:
        return {}
    offsets = np.unique(grasps.offset)
    curves: Curves = {AXIS: [round(100 * float(offset), 3) for offset in offsets]}
    worlds = {SIMULATOR: grasps.success, MODEL: grasps.prediction > LIFTED}
    for name, success in worlds.items():
        shares = [wilson(int(success[at].sum()), int(at.sum())) for at in (grasps.offset == each for each in offsets)]
        curves[name] = [share.value for share in shares]
        curves[f"{name}_low"] = [share.low for share in shares]
        curves[f"{name}_high"] = [share.high for share in shares]
    return curves


def _wrong(scene: Scene, success: bool) -> Scores:
    """Returns, for the grasps that end so in the simulator, whether they end otherwise in the scene."""
    grasps = scene.grasps
    rows = grasps.success == success
    if not rows.any():
        raise Unavailable(f"none of {len(rows)} grasps has success = {success} in the simulator")
    return {part: ((p[rows] > LIFTED) != success).astype(float) for part, p in grasps.read().items()}
