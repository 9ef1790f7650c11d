"""Questions that the paper leaves open: how actions enter, and what annotations with errors cost."""

from rsjax.tools.studies.paper.claim import Arm, Claim, pairs, register

_METRICS = ("psnr", "psnr_motion", "delta_psnr", "gripper_error_widths")
_HEAD = {"model.depth": "head"}

register(
    Claim(
        name="action-conditioning",
        title="Actions by adaptive norms instead of addition",
        statement="Feature modulation by actions makes the better world model than adding them to the features.",
        place="the other side of §2.3 (Eq. 2) and of the authors' answer to W8",
        arms=(Arm("addition (the paper's)"), Arm("adaptive norms", {"model.action_encoder": "norms"})),
        comparisons=pairs("adaptive norms", "addition (the paper's)", *_METRICS),
        shown=("delta_psnr_uniform", "cube_error_widths", "ssim", "depth_absrel"),
        rank=4,
        notes=(
            'The paper: "simple additive fusion provides effective action control while maintaining model efficiency"; '
            "the authors call feature modulation more costly (W8).",
            "Both arms train for the same steps. Norms take 0.8 % more operations (at the size of tiny), and their "
            "blocks have 56 % more parameters; the table of trainings has the measured minutes.",
        ),
    )
)

register(
    Claim(
        name="label-noise",
        title="Annotations with errors instead of exact ones",
        statement="Exact depth and tracks make the better world model than those that are estimated from the frames.",
        place="authors' answers, W1: annotations come from off-the-shelf models",
        arms=(
            Arm("exact", _HEAD),
            Arm("tracks by Lucas–Kanade", _HEAD, annotations="estimated_tracks"),
            Arm("depth by a network", _HEAD, annotations="estimated_depth"),
            Arm("both estimated", _HEAD, annotations="estimated"),
        ),
        comparisons=(
            *pairs("exact", "tracks by Lucas–Kanade", *_METRICS),
            *pairs("exact", "depth by a network", *_METRICS, "depth_absrel"),
            *pairs("exact", "both estimated", *_METRICS, "depth_absrel"),
        ),
        shown=("cube_error_widths", "ssim"),
        rank=4,
        notes=(
            "A second head predicts depth, and the keypoint terms are the printed Eq. 5 and 7. Estimates replace the "
            "training clips' annotations alone: tokenizer, prompts and the truth of every score are exact.",
            "Each clip's depth is estimated by a network that learned from other clips. The manifest of the clips has "
            "the mean errors of their estimates.",
            "All arms train for the same steps.",
        ),
    )
)
