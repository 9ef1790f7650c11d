"""The keypoint terms that the paper does not have, each defined in its own file, as means over T_sample.

Axes: B clips, T frames, H×W = S cells, n vocabularies of V codes, C width, K keypoints.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rsjax.config import RoboScapeConfig
from rsjax.models.roboscape.departures.keypoint_difference import difference
from rsjax.models.roboscape.departures.keypoint_features import feature_distance
from rsjax.models.roboscape.departures.motion_head import motion_error
from rsjax.models.roboscape.departures.observed_anchor import anchor
from rsjax.tokenizers import lfq
from rsjax.trainable import Term


def other_keypoint_term(
    config: RoboScapeConfig,
    bits: int,
    logits: Float[Array, "B T S n V"],
    targets: Int[Array, "B T H W"],
    points: Float[Array, "B T K 2"],
    cells: Int[Array, "B T K"],
    visible: Bool[Array, "B T K"],
    weight: Float[Array, " B"],
    trunk: Float[Array, "B T S C"] | None,
    motion: Float[Array, "B T S 3"] | None,
) -> Term:
    """Returns the sum of the term that ``config.keypoint_term`` names, and its weight.

    A point counts only where it is visible.

    Args:
        bits: of a code.
        logits: of RGB.
        targets: the true tokens of RGB.
        points: the keypoints, in units of cells.
        cells: the keypoints' cells.
        visible: the frames that show each keypoint.
        weight: of each clip.
        trunk: the RGB branch's features, for "feature".
        motion: the motion head's outputs, for "motion".
    """
    if config.keypoint_term == "difference":
        s_hat = lfq.mean_codes(logits, bits)
        s = lfq.tokens_to_codes(targets, bits).reshape(s_hat.shape)
        first = anchor(config.departures, s_hat, targets)
        errors = difference(jnp.concatenate([first, s_hat[:, 1:]], axis=1), s, cells)
        counts = visible[:, 1:] & visible[:, :-1]
    elif config.keypoint_term == "motion":
        assert motion is not None
        errors = bits * motion_error(motion, points, visible, cells)
        counts = visible[:, :-1]
    else:
        assert trunk is not None
        errors = bits * feature_distance(trunk, cells)
        counts = visible[:, 1:] & visible[:, :1]
    counts = counts * weight[:, None, None]
    return jnp.sum(errors * counts), jnp.sum(counts)
