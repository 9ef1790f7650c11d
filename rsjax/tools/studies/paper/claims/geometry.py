"""RoboScape against a world model that denoises RGB and depth together, as channels of one latent."""

from rsjax.tools.studies.paper.claim import ESTIMATED_DEPTH, Arm, Claim, pairs, register
from rsjax.tools.studies.paper.claims.baselines import RATES

_OWN_DEPTH = ("depth_absrel", "depth_delta1", "depth_delta2")
_RGB = ("psnr", "psnr_motion", "ssim", "delta_psnr", "lpips_alex")

register(
    Claim(
        name="geometry",
        title="RoboScape against RGB and depth as channels of one diffusion model",
        statement=(
            "Although some recent world models [Aether, TesserAct] also explore joint RGB-depth prediction … these "
            "approaches exhibit a performance trade-off, where gains in 3D perception come at the cost of reduced RGB "
            "prediction fidelity. As extra channels … the key limitation is … a weak coupling between these channels."
        ),
        place="§1; authors' answers, reviewers NSMY and XShs",
        arms=(
            Arm("RoboScape", rate=RATES["RoboScape"]),
            Arm("RGB and depth as channels", preset="irasim_rgbd", equal="seconds", rate=RATES["IRASim"]),
            Arm("RGB alone", preset="irasim", equal="seconds", rate=RATES["IRASim"]),
        ),
        comparisons=(
            *pairs("RoboScape", "RGB and depth as channels", *_RGB, *_OWN_DEPTH, *ESTIMATED_DEPTH),
            *pairs("RGB and depth as channels", "RGB alone", *ESTIMATED_DEPTH),
            *pairs("RGB alone", "RGB and depth as channels", "psnr", "ssim", "delta_psnr"),
        ),
        rank=3,
        notes=(
            "The paper trains neither Aether nor TesserAct, whose training code was not public. The rival is IRASim's "
            "transformer, since theirs reads no robot actions, with their way to use depth (docs/baselines.md).",
            "Same clips, actions and evaluation, equal time. The rival has IRASim's learning rate, not tuned for it.",
            "depth_absrel, δ1 and δ2 are those of the depth that a model generates; the others are an estimator's.",
        ),
    )
)
