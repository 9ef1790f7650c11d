"""Grasps that do not last: the cube is held at its edge, shaken, let go in the air, or let go and caught again."""

from dataclasses import dataclass

import numpy as np

from rsjax.tools.sim.expert import CLOSE, OPEN
from rsjax.tools.sim.recipes.script import Moves, Scripted, See, go, hover, stay

HOW = ("edge", "shake", "drop", "blink")
SHAKE = 0.05  # metres to either side


@dataclass(frozen=True)
class SlipManner:
    """A grasp that does not last; lengths in metres, times in control steps.

    Attributes:
        how: edge holds the cube's edge and moves on, shake moves quickly to and fro, drop opens the fingers, blink
            opens them and closes them again.
        offset: from the cube's centre to the point where the fingers close.
        carry: displacement after the fingers have closed.
        lifted: steps of the lift before the fingers open, or the gripper is shaken.
        open: steps for which they stay open: after a drop to the end, after a blink for a moment.
        after: displacement after that.
        speed, noise, delay: as in :class:`rsjax.tools.sim.expert.Manner`.
    """

    mode: str
    how: str
    offset: tuple[float, float, float]
    carry: tuple[float, float, float]
    lifted: int
    open: int
    after: tuple[float, float, float]
    speed: float
    noise: float
    delay: int

    def expert(self, rng: np.random.Generator) -> Scripted:
        """Returns the policy of an episode; ``rng`` draws the noise."""
        return Scripted(self, self.moves, (self.noise, 0.02), rng)

    def moves(self, see: See) -> Moves:
        """Grasps, lifts, and loses the cube or tries to."""
        yield from stay(OPEN, self.delay)
        yield from hover(see, np.array([0, 0, 0.07]), self.speed, steps=24)
        point = see().cube + np.array(self.offset)
        yield from go(see, point, OPEN, self.speed, steps=14, near=0.007)
        yield from go(see, point, CLOSE, self.speed, steps=6)
        up = point + np.array(self.carry)
        yield from go(see, up, CLOSE, self.speed, self.lifted)
        here = see().gripper.copy()
        if self.how == "shake":
            for side in (1, -1, 1, -1):
                aim = here + side * SHAKE * np.array([np.sign(self.after[0]), np.sign(self.after[1]), 0])
                yield from go(see, aim, CLOSE, 1.0, steps=4)
        elif self.how == "drop":
            yield from go(see, here + np.array(self.after), OPEN, self.speed, steps=60)
        elif self.how == "blink":
            yield from go(see, up, OPEN, self.speed, self.open)
            yield from go(see, here + np.array(self.after), CLOSE, self.speed, steps=60)
        yield from go(see, up, CLOSE, self.speed, steps=60)


def slips(rng: np.random.Generator, number: int) -> SlipManner:
    """Draws a grasp that does not last; the episode's number chooses how it ends."""
    how = HOW[number % len(HOW)]
    angle = rng.uniform(0, 2 * np.pi)
    beside = rng.uniform(0.0, 0.012)
    if how in ("edge", "shake"):
        beside = rng.uniform(0.02, 0.036)
    return SlipManner(
        mode="slips",
        how=how,
        offset=(float(beside * np.cos(angle)), float(beside * np.sin(angle)), float(rng.uniform(-0.006, 0.016))),
        carry=(float(rng.uniform(-0.05, 0.1)), float(rng.uniform(-0.12, 0.12)), float(rng.uniform(0.06, 0.2))),
        lifted=int(rng.integers(2, 14)),
        open=int(rng.integers(2, 9)),
        after=(float(rng.uniform(-0.1, 0.1)), float(rng.uniform(-0.12, 0.12)), float(rng.uniform(-0.08, 0.08))),
        speed=float(rng.uniform(0.75, 1.0)),
        noise=float(rng.uniform(0.0, 0.1)),
        delay=int(rng.integers(0, 3)),
    )
