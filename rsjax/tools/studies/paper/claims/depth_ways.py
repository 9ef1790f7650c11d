"""Ways to use depth, beside models without it, at equal time, operations and steps."""

from dataclasses import replace
from typing import Literal

from rsjax.tools.studies.paper.claim import ESTIMATOR_ERROR, Arm, Claim, pairs, register
from rsjax.tools.studies.paper.claims.baselines import RATES

_METRICS = ("psnr", "psnr_motion", "delta_psnr", "depth_absrel_median_estimator")
_SHOWN = (
    *("ssim", "lpips_alex", "gripper_error_widths", "cube_error_widths"),
    *("depth_delta1_median_estimator", "depth_delta2_median_estimator", ESTIMATOR_ERROR),
)

# Without keypoint terms, which have claims of their own.
_ALONE = {"model.loss.keypoints": "none"}
_ARMS = (
    Arm("second head", {"model.depth": "head", **_ALONE}),
    Arm("branch (the paper's)", _ALONE, rate=RATES["RoboScape"]),
    Arm("Genie", model="genie", rate=RATES["Genie"]),
    Arm("no depth, twice the blocks", {"model.depth": "none", "model.blocks": 8, "model.unroll": 8, **_ALONE}),
)

# Other ways, whose learning rates were not tuned. Widths are a half and a quarter of RGB's.
_CHEAPER = (
    Arm("branch of half the width", {"model.depth": "small_branch", "model.depth.width": 64, **_ALONE}),
    Arm("branch of a quarter of the width", {"model.depth": "small_branch", "model.depth.width": 32, **_ALONE}),
    Arm("branch of half the blocks", {"model.depth": "small_branch", "model.depth.blocks": 2, **_ALONE}),
    Arm("branch at cells of 2 × 2", {"model.depth": "small_branch", "model.depth.cells": 2, **_ALONE}),
    Arm("head that can be dropped", {"model.depth": "head", "model.depth.feed_back": False, **_ALONE}),
)


def _register(name: str, equal: Literal["seconds", "flops", "steps"], title: str, rank: int) -> None:
    """Registers the claims about the main ways and about the cheaper ones."""
    register(
        Claim(
            name=name,
            title=f"Depth as a second head at equal {title}",
            statement="Depth predicted by a second head on the branch of RGB makes the better world model.",
            place="a choice of ours beside §2.3",
            arms=tuple(replace(arm, equal=equal) for arm in _ARMS),
            comparisons=tuple(pair for arm in _ARMS[1:] for pair in pairs(_ARMS[0].name, arm.name, *_METRICS)),
            shown=_SHOWN,
            rank=rank,
            notes=(
                f"All arms train for equal {title}.",
                "Branch and Genie have the best of four learning rates; the others have Genie's, not tuned for them.",
                "No arm has keypoint terms. Twice the blocks without depth are the paper's branches without depth.",
            ),
        )
    )
    head, _, genie, control = (replace(arm, equal=equal) for arm in _ARMS)
    cheaper = tuple(replace(arm, equal=equal) for arm in _CHEAPER)
    against_head = tuple(pair for arm in cheaper for pair in pairs(head.name, arm.name, *_METRICS))
    against_genie = tuple(pair for arm in cheaper for pair in pairs(arm.name, genie.name, "psnr", "delta_psnr"))
    register(
        Claim(
            name=f"cheaper-{name}",
            title=f"Smaller depth branches, and a head that can be dropped, at equal {title}",
            statement="A second head beats smaller branches for depth and a head that RGB does not read; these beat a "
            "model without depth.",
            place="a choice of ours beside §2.3",
            arms=(head, *cheaper, genie, control),
            comparisons=(*against_head, *against_genie),
            shown=_SHOWN,
            rank=rank + 2,
            notes=(
                f"All arms train for equal {title}. Second head, Genie and twice the blocks are those of {name}.",
                "Genie has the best of four learning rates; the others have the same rate, not tuned for them.",
                "Seconds are estimates (docs/depth.md has measured steps); the table has the measured minutes.",
            ),
        )
    )


_register("depth-ways", "seconds", "time", 2)
_register("depth-ways-flops", "flops", "operations", 4)
_register("depth-ways-steps", "steps", "steps", 4)
