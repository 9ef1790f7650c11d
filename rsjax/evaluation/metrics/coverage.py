"""How far the clips are from the training clips, and whether the model errs more on those that are farther.

:mod:`rsjax.evaluation.coverage` has the definition.
"""

import numpy as np

from rsjax.evaluation.metrics.psnr import per_frame
from rsjax.evaluation.registry import Scene, Score, Scores, Unavailable, metric

PERCENT = 100.0


@metric("coverage", "distance from the training clips", better="lower", decimals=2, column=False)
def coverage(scene: Scene) -> Scores:
    """Returns the distance of each clip in units of the median training clip's, and as ``_percentile`` its percentile.

    ``_error_correlation`` is Spearman's correlation, over the clips, of the distance with the loss of PSNR: 1 if the
    order of distances is that of errors. It is missing where one of them does not vary.
    """
    from scipy.stats import rankdata  # not at the start, as it takes a second or two

    if scene.familiarity is None:
        raise Unavailable("no bank of training clips was made, or this family of models has no features")
    far = scene.familiarity.coverage
    scores: dict[str, Score] = {"": far, "_percentile": PERCENT * scene.familiarity.percentile}
    psnr = scene.shared(per_frame).mean(-1)
    with np.errstate(invalid="ignore"):
        spearman = float(np.corrcoef(rankdata(far), rankdata(-psnr))[0, 1])
    if np.isfinite(spearman):
        scores["_error_correlation"] = spearman
    return dict(scores)
