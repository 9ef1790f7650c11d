"""Figures 6 and 7: larger models and more data."""

from rsjax.tools.studies.paper.claim import ESTIMATED_DEPTH, ESTIMATOR_ERROR, Arm, Claim, pairs, register

_METRICS = ("psnr", "delta_psnr", "lpips_alex", "depth_absrel", *ESTIMATED_DEPTH, "ssim")

register(
    Claim(
        name="model-scaling",
        title="Larger models are better",
        statement=(
            "We evaluate three model variants, RoboScape-S (34M), RoboScape-M (131M), and RoboScape-L (544M), and "
            "observe a clear scaling law: all six evaluation metrics improve significantly as model capacity increases."
        ),
        place="Appendix C, Fig. 6",
        arms=(
            Arm("S", {"model.width": 32, "model.heads": 1}),
            Arm("M", {"model.width": 64, "model.heads": 2}),
            Arm("L"),
        ),
        comparisons=(*pairs("M", "S", *_METRICS), *pairs("L", "M", *_METRICS)),
        shown=(ESTIMATOR_ERROR,),
        rank=3,
        notes=("Widths 32, 64 and 128 in equal steps, as the paper's double too; L is the base preset.",),
    )
)
register(
    Claim(
        name="data-scaling",
        title="More data is better",
        statement=(
            "Increasing data size consistently enhances visual quality and action controllability; geometric accuracy "
            "exhibits marginal improvement or even slight degradation."
        ),
        place="Appendix C, Fig. 7",
        arms=(Arm("a sixth", data=1 / 6), Arm("a half", data=1 / 2), Arm("all")),
        comparisons=(
            *pairs("a half", "a sixth", "psnr", "delta_psnr"),
            *pairs("all", "a half", "psnr", "delta_psnr"),
        ),
        shown=("lpips_alex", "ssim", *ESTIMATED_DEPTH, ESTIMATOR_ERROR),
        rank=3,
        notes=(
            "1, 3 and 6 parts of the clips, as in the paper, in equal steps; the tokenizer has seen all of them. "
            "Geometry is not part of the claim, as the paper finds it does not improve.",
        ),
    )
)
