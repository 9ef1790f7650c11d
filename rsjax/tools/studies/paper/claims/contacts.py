"""What makes a model of contacts that a policy can trust: the training clips, and the size of the token cells."""

from rsjax.tools.studies.paper.claim import Arm, Claim, pairs, register

# The model that both are chosen for: depth as a second head, without keypoint terms.
_MODEL = {"model.depth": "head", "model.loss.keypoints": "none"}
MIX = ("expert=0.35", "grasps=0.35", "driving=0.15", "novices=0.1", "slips=0.05")
_MIXED = Arm("mixed", {**_MODEL, "sim.recipe": MIX}, equal="seconds")
_METRICS = (
    "contact_false_success",
    "contact_false_failure",
    "contact_brier",
    "drive_gripper_error_widths",
    "drive_psnr",
    "psnr",
    "delta_psnr",
)
_SHOWN = ("cube_error_widths", "gripper_error_widths", "lifted_accuracy", "contact_judge_accuracy")

register(
    Claim(
        name="recipes",
        title="Training clips in which position decides",
        statement="Paired grasps, free driving and failures among the training clips teach contacts, and cost little "
        "elsewhere.",
        place="a choice of ours beside §3",
        arms=(_MIXED, Arm("expert alone", _MODEL, equal="seconds")),
        comparisons=pairs("mixed", "expert alone", *_METRICS),
        shown=_SHOWN,
        rank=2,
        notes=(
            "As many clips, and equal time; the test clips are the expert's in both arms.",
            f"The mix is {', '.join(MIX)}; its shares were chosen before any training.",
        ),
    )
)

register(
    Claim(
        name="fine-codes",
        title="Token cells of 4 pixels",
        statement="With 16 × 16 cells a frame instead of 8 × 8 the model sees whether the fingers hold the cube.",
        place="a choice of ours beside §2.3",
        arms=(
            Arm("16 × 16 cells", {**_MIXED.values, "tokenizer.patch_size": 2}, equal="seconds"),
            Arm("8 × 8 cells", _MIXED.values, equal="seconds"),
        ),
        comparisons=pairs("16 × 16 cells", "8 × 8 cells", *_METRICS),
        shown=_SHOWN,
        rank=4,
        notes=("Both train for equal time on the mix of the claim recipes.",),
    )
)
