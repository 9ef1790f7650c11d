"""The same number of learning rates tried for every family of Table 1."""

from dataclasses import replace

from rsjax.tools.studies.paper.claim import Arm, Claim, pairs, register
from rsjax.tools.studies.paper.claims.baselines import TABLE_1

_FACTORS = {
    factor: "the preset's rate" if factor == 1 else f"{factor:g} × the preset's rate"
    for factor in (0.3, 1.0, 3.0, 10.0)
}


def _trials(arm: Arm) -> tuple[Arm, ...]:
    """Returns an arm of Table 1, and copies of it with the other learning rates of the world model."""
    others = {factor: what for factor, what in _FACTORS.items() if factor != arm.rate}
    return (
        replace(arm, published={}),
        *(replace(arm, name=f"{arm.name}, {what}", rate=factor, published={}) for factor, what in others.items()),
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
        notes=("Four trials a family; autoencoders keep the rates of their presets.",),
    )
)
