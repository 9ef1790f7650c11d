"""Learning rates and batch sizes, tried on clips that no table scores: as many for every arm."""

from dataclasses import replace

from rsjax.tools.studies.paper.claim import Arm, Claim, pairs, register
from rsjax.tools.studies.paper.claims.baselines import RATES, TABLE_1

_FACTORS = {
    factor: "the preset's rate" if factor == 1 else f"{factor:g} × the preset's rate"
    for factor in (0.3, 1.0, 3.0, 10.0)
}
CLIPS = {"sim.seed": 1000}  # the seeds of tables are far below


def _trials(arm: Arm) -> tuple[Arm, ...]:
    """Returns an arm of Table 1 on clips of its own, and copies of it with the other learning rates of the model."""
    arm = replace(arm, values={**arm.values, **CLIPS}, published={})
    others = {factor: what for factor, what in _FACTORS.items() if factor != arm.rate}
    return (
        arm,
        *(replace(arm, name=f"{arm.name}, {what}", rate=factor) for factor, what in others.items()),
    )


_TRIALS = {arm.name: _trials(arm) for arm in TABLE_1.arms}

register(
    Claim(
        name="learning-rates",
        title="The learning rates of Table 1",
        statement="Each family of Table 1 has the best of four learning rates.",
        place="the fairness of Table 1",
        arms=tuple(trial for trials in _TRIALS.values() for trial in trials),
        comparisons=tuple(
            comparison
            for chosen, *others in _TRIALS.values()
            for other in others
            for comparison in pairs(chosen.name, other.name, "psnr")
        ),
        rank=6,
        notes=(
            "Four trials a family; autoencoders keep the rates of their presets.",
            "The clips have a seed of their own, so a rate is not chosen on clips on which a table scores it.",
        ),
    )
)

_BATCHES = {
    arm.name: tuple(
        replace(
            arm,
            name=f"{arm.name}, {size} clips a step",
            values={**arm.values, **CLIPS, "train.batch_size": size},
            equal="seconds",
        )
        for size in (4, 2, 8)
    )
    for arm in (
        Arm("RoboScape", rate=RATES["RoboScape"]),
        Arm("second head", {"model.depth": "head", "model.loss.keypoints": "none"}),
        Arm("Genie", model="genie", rate=RATES["Genie"]),
    )
}

register(
    Claim(
        name="batch-sizes",
        title="The batch size of the small presets",
        statement="Four clips a step are better than two or eight, in equal time.",
        place="the fairness of Table 1",
        arms=tuple(arm for arms in _BATCHES.values() for arm in arms),
        comparisons=tuple(
            comparison
            for usual, *others in _BATCHES.values()
            for other in others
            for comparison in pairs(usual.name, other.name, "psnr")
        ),
        rank=6,
        notes=("The learning rates are those of four clips a step. The clips are those of the claim learning-rates.",),
    )
)
