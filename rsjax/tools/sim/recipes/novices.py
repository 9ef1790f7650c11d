"""Attempts of policies from useless to good, as they are while they learn: imprecise, late, hesitant, and persistent.

Scripted, so that they need no trained policy; the recipe ``recorded:PATH`` takes the episodes of trained ones.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np

from rsjax.tools.sim.expert import CLOSE, OPEN, yaw_action
from rsjax.tools.sim.recipes.script import Moves, Scripted, See, stay, towards

PLAN = 8  # control steps between two looks at the cube, as between a Diffusion Policy's plans
BIAS = 0.05  # metres: standard deviation, along each horizontal axis, of a useless policy's error in an attempt
JITTER = 0.03  # metres: likewise, of the error that changes with every look
STEADY_SHARE = 0.5  # of the policies: they err without hesitation, so that nothing but the place tells it


@dataclass(frozen=True)
class NoviceManner:
    """The attempts of one policy; lengths in metres, times in control steps.

    Attributes:
        skill: 0 is useless, 1 as good as the script.
        speed, noise: as in :class:`rsjax.tools.sim.expert.Manner`.
        jitter: 1 if the error changes with every look, 0 if not.
        turn: angle between the fingers and the cube's sides, radians.
        early: height above the grasp at which the fingers begin to close.
        carry: displacement after the fingers have closed.
    """

    mode: str
    skill: float
    speed: float
    noise: float
    jitter: int
    turn: float
    early: float
    carry: tuple[float, float, float]

    def expert(self, rng: np.random.Generator) -> Scripted:
        """Returns the policy of an episode; ``rng`` draws its errors and the noise."""
        return Scripted(self, partial(self.moves, rng), (self.noise, self.noise / 4), rng)

    def moves(self, rng: np.random.Generator, see: See) -> Moves:
        """Reaches for where it sees the cube, closes, lifts; tries again where it sees that it has failed."""
        yield from stay(OPEN, int(rng.integers(0, 4)))
        while True:
            yield from reach(self, rng, see)
            yield from stay(CLOSE, int(rng.integers(3, 8)))
            up = see().gripper + np.array(self.carry)
            for _ in range(12):
                yield towards(see(), up, CLOSE, self.speed)
            while np.abs(see().cube - see().gripper).max() < 0.04:  # it holds the cube
                yield towards(see(), up, CLOSE, self.speed)


def novices(rng: np.random.Generator, number: int) -> NoviceManner:
    """Draws the attempts of one policy, whatever the episode's number."""
    skill = float(rng.random())
    jitter = int(rng.random() >= STEADY_SHARE)
    return NoviceManner(
        mode="novices",
        skill=skill,
        speed=float(rng.uniform(0.5 + 0.3 * skill, 1.0)),
        noise=float(jitter * (1 - skill) * rng.uniform(0.0, 0.3)),
        jitter=jitter,
        turn=float(rng.choice([0, 1]) * rng.uniform(-np.pi / 4, np.pi / 4)),
        early=float(abs(rng.normal(0, 0.03 * (1 - skill)))),
        carry=(float(rng.uniform(-0.04, 0.1)), float(rng.uniform(-0.1, 0.1)), float(rng.uniform(0.1, 0.2))),
    )


def reach(manner: NoviceManner, rng: np.random.Generator, see: See) -> Moves:
    """Moves over the cube and down to it, for as long as the fingers are not where they are to close."""
    wrong = (1 - manner.skill) * np.array([BIAS, BIAS, 0.01]) * rng.standard_normal(3)
    jitter = (1 - manner.skill) * manner.jitter * np.array([JITTER, JITTER, 0.3 * JITTER])
    height = 0.07
    for _ in range(6):
        perceived = see().cube + wrong + jitter * rng.standard_normal(3)
        for _ in range(PLAN):
            turn = yaw_action(see(), manner.turn)
            yield towards(see(), perceived + np.array([0, 0, height]), OPEN, manner.speed, turn)
            apart = np.abs(see().gripper - perceived)
            if height == 0.0 and apart[:2].max() < 0.02 and apart[2] < 0.012 + manner.early:
                return
        if np.hypot(*(see().gripper - perceived)[:2]) < 0.03:
            height = 0.0
