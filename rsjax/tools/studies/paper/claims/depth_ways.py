"""Ways to use depth, beside models without it, at equal time, operations and steps."""

from dataclasses import replace
from typing import Literal

from rsjax.tools.studies.paper.claim import Arm, Claim, pairs, register
from rsjax.tools.studies.paper.claims.baselines import RATES

_METRICS = ("psnr", "psnr_motion", "delta_psnr", "depth_absrel_median_estimator")
_SHOWN = ("ssim", "lpips_alex", "gripper_error_widths", "cube_error_widths", "depth_delta1_median_estimator")

# Without keypoint terms, which have claims of their own.
_ALONE = {"model.loss.keypoints": "none"}
_ARMS = (
    Arm("second head", {"model.depth": "head", **_ALONE}),
    Arm("branch (the paper's)", _ALONE, rate=RATES["RoboScape"]),
    Arm("Genie", model="genie", rate=RATES["Genie"]),
    Arm("no depth, twice the blocks", {"model.depth": "none", "model.blocks": 8, "model.unroll": 8, **_ALONE}),
)


def _register(name: str, equal: Literal["seconds", "flops", "steps"], title: str, rank: int) -> None:
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


_register("depth-ways", "seconds", "time", 2)
_register("depth-ways-flops", "flops", "operations", 4)
_register("depth-ways-steps", "steps", "steps", 4)
