"""The authors' answer on curriculum learning: simple tasks first."""

from rsjax.tools.studies.paper.claim import Arm, Claim, pairs, register

EPOCHS = {"simple": 2, "difficult": 3}

register(
    Claim(
        name="curriculum",
        title="Simple tasks first",
        statement=(
            "Our approach employs a two-stage curriculum learning strategy based on task difficulty: initially 2 "
            "epochs on the simple tasks, then 3 epochs on the difficult tasks."
        ),
        place="§2.2; authors' answers, W10",
        arms=(Arm("curriculum", curriculum=EPOCHS), Arm("mixed", curriculum=EPOCHS, mixed=True)),
        comparisons=pairs("curriculum", "mixed", "psnr", "delta_psnr", "depth_absrel"),
        shown=("lpips_alex", "depth_absrel_median_estimator"),
        rank=4,
        notes=(
            "Both arms draw the same shares of simple and difficult clips in the same number of steps; the paper "
            "reports no number. Simple in Lift: the expert lifts the cube; difficult: it misses, drops it or explores. "
            "Simple in Meta-World: the tasks that Seo et al. (2022) call easy.",
        ),
    )
)
