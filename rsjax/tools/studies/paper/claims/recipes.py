"""What training clips show: episodes in which position decides, beside the scripted expert's alone."""

from rsjax.tools.studies.paper.claim import Arm, Claim, pairs, register

# The model that the mix is chosen for: depth as a second head, without keypoint terms.
_MODEL = {"model.depth": "head", "model.loss.keypoints": "none"}
MIX = ("expert=0.35", "grasps=0.35", "driving=0.15", "novices=0.1", "slips=0.05")

register(
    Claim(
        name="recipes",
        title="Training clips in which position decides",
        statement="Paired grasps, free driving and failures among the training clips teach contacts, and cost little "
        "elsewhere.",
        place="a choice of ours beside §3",
        arms=(
            Arm("mixed", {**_MODEL, "sim.recipe": MIX}, equal="seconds"),
            Arm("expert alone", _MODEL, equal="seconds"),
        ),
        comparisons=pairs(
            "mixed",
            "expert alone",
            "contact_false_success",
            "contact_false_failure",
            "contact_brier",
            "drive_gripper_error_widths",
            "drive_psnr",
            "psnr",
            "delta_psnr",
        ),
        shown=("cube_error_widths", "gripper_error_widths", "lifted_accuracy", "contact_judge_accuracy"),
        rank=2,
        notes=(
            "As many clips, and equal time; the test clips are the expert's in both arms.",
            f"The mix is {', '.join(MIX)}; its shares were chosen before any training.",
        ),
    )
)
