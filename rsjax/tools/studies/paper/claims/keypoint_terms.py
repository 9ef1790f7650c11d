"""Keypoint terms beside that of Eq. 5, on a model whose second head predicts depth."""

from collections.abc import Iterable, Mapping
from typing import Any

from rsjax.tools.studies.paper.claim import ESTIMATOR_ERROR, Arm, ArmComparison, Claim, pairs, register

_HEAD = {"model.depth": "head"}
_TERMS: dict[str, dict[str, Any]] = {
    "printed Eq. 5 and 7": {},
    "difference of codes": {"model.loss.keypoints": "difference", "model.loss.attention_weight": 0.0},
    "motion head": {"model.loss.keypoints": "motion", "model.loss.attention_weight": 0.0},
    "features along a track": {"model.loss.keypoints": "feature", "model.loss.attention_weight": 0.0},
    "one normalised weight": {"model.loss.keypoint_weight": 0.0, "model.loss.attention": "normalised"},
}


def _with_and_without(terms: Mapping[str, Mapping[str, Any]]) -> tuple[Arm, ...]:
    """Returns an arm without any term, and one with each of these."""
    arms = [Arm("without", _HEAD | {"model.loss.keypoints": "none"})]
    return (*arms, *(Arm(name, {**_HEAD, **values}) for name, values in terms.items()))


def _against_without(terms: Iterable[str], *metrics: str) -> tuple[ArmComparison, ...]:
    """Returns the comparisons of each term with none."""
    return tuple(pair for name in terms for pair in pairs(name, "without", *metrics))


register(
    Claim(
        name="keypoint-terms",
        title="Keypoint terms whose minimum is the truth",
        statement="A term on tracked points that the true video minimises makes moving regions better.",
        place="choices of ours beside Eq. 5 and 7",
        arms=_with_and_without(_TERMS),
        comparisons=_against_without(_TERMS, "psnr_motion", "cube_error_widths", "gripper_error_widths", "psnr"),
        shown=("delta_psnr", "lpips_alex", "depth_absrel_median_estimator", ESTIMATOR_ERROR),
        rank=3,
        notes=("All arms train for the same steps. The terms that are not in the paper come without Eq. 7.",),
    )
)

_PRINTED: dict[str, dict[str, Any]] = {
    "Eq. 5 alone": {"model.loss.attention_weight": 0.0},
    "Eq. 7 alone": {"model.loss.keypoint_weight": 0.0},
    "printed Eq. 5 and 7": {},
}

register(
    Claim(
        name="printed-terms",
        title="Eq. 5 and Eq. 7, each alone and together",
        statement="Keypoint learning proves essential for both visual fidelity and action controllability.",
        place="§3.2, of Eq. 5 and Eq. 7 one by one",
        arms=_with_and_without(_PRINTED),
        comparisons=_against_without(_PRINTED, "psnr", "psnr_motion", "delta_psnr"),
        shown=("cube_error_widths", "gripper_error_widths", "lpips_alex", "depth_absrel_median_estimator"),
        rank=5,
        notes=("All arms train for the same steps and predict depth by a second head.",),
    )
)

_WEIGHTS = {
    "moving cells": {"model.loss.keypoint_weight": 0.0, "model.loss.attention": "normalised"},
    "contact cells": {"model.loss.keypoint_weight": 0.0, "model.loss.attention": "contact"},
}

register(
    Claim(
        name="attention-cells",
        title="One normalised weight, spent on moving or on contact cells",
        statement="A cross-entropy that counts the cells of things that are moved more brings them to the right place.",
        place="a choice of ours beside Eq. 7",
        arms=_with_and_without(_WEIGHTS),
        comparisons=_against_without(_WEIGHTS, "cube_error_widths", "gripper_error_widths", "psnr_motion", "psnr"),
        shown=("delta_psnr", "lifted_accuracy", "lpips_alex", "depth_absrel_median_estimator"),
        rank=5,
        notes=("All arms train for the same steps. Contact cells are those of points that rest before they move.",),
    )
)

_NEW = ("difference of codes", "motion head")
_ALL = {"model.loss.num_keypoints": 256}  # N₀, all tracks of the presets

register(
    Claim(
        name="keypoint-density",
        title="Dense points instead of those that move most",
        statement="Differences of codes and the motion head make moving regions better with all points than with 32.",
        place="a reviewer's question on optical flow",
        arms=(
            *(Arm(f"{name}, 32 points", _HEAD | _TERMS[name]) for name in _NEW),
            *(Arm(f"{name}, all points", _HEAD | _TERMS[name] | _ALL) for name in _NEW),
        ),
        comparisons=tuple(
            pair
            for name in _NEW
            for pair in pairs(
                f"{name}, all points",
                f"{name}, 32 points",
                *("psnr_motion", "cube_error_widths", "gripper_error_widths", "psnr"),
            )
        ),
        shown=("delta_psnr", "lpips_alex", "depth_absrel_median_estimator"),
        rank=5,
        notes=("All arms train for the same steps. Both terms compare a frame with the one before it.",),
    )
)
