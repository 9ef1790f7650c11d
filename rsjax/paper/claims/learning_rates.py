"""The same number of learning rates tried for every family of Table 1."""

from dataclasses import replace

from rsjax.paper.claim import Arm, Claim, pairs, register
from rsjax.paper.claims.baselines import TABLE_1

_FACTORS = {"0.3 × the rate": 0.3, "3 × the rate": 3.0}


def _trials(arm: Arm) -> tuple[Arm, ...]:
    """Returns an arm of Table 1, and copies of it with other learning rates of the world model."""
    arm = replace(arm, published={})
    return (arm, *(replace(arm, name=f"{arm.name}, {what}", rate=factor) for what, factor in _FACTORS.items()))


register(
    Claim(
        name="learning-rates",
        title="The learning rates of Table 1",
        statement="No family of Table 1 is better with another of three learning rates.",
        place="the fairness of Table 1",
        arms=tuple(trial for arm in TABLE_1.arms for trial in _trials(arm)),
        comparisons=tuple(
            each for arm in TABLE_1.arms for what in _FACTORS for each in pairs(arm.name, f"{arm.name}, {what}", "psnr")
        ),
        rank=6,
        notes=("Three trials a family; autoencoders keep the rates of their presets.",),
    )
)
