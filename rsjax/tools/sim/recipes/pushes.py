"""Pushes: the gripper comes down beside the cube and moves along the table, past the cube, against it or through it."""

from dataclasses import dataclass

import numpy as np

from rsjax.tools.sim.expert import CLOSE, OPEN, TABLE_HEIGHT
from rsjax.tools.sim.recipes.script import Moves, Scripted, See, go, stay

CLOSED_SHARE = 0.7  # of the pushes; the others push with open fingers
BACK_SHARE = 0.4  # of the pushes, after which the gripper goes back the way it came


@dataclass(frozen=True)
class PushManner:
    """A push; lengths in metres, times in control steps.

    Attributes:
        angle: direction of the push in the plane of the table, radians.
        start: from the cube's centre to the point where the gripper comes down, against the direction.
        miss: from the cube's centre to the line of the push.
        height: of the gripper above the table.
        length: of the push, from where the gripper came down.
        finger: the gripper's action.
        back: whether the gripper goes back afterwards.
        speed, noise, delay: as in :class:`rsjax.tools.sim.expert.Manner`.
    """

    mode: str
    angle: float
    start: float
    miss: float
    height: float
    length: float
    finger: float
    back: bool
    speed: float
    noise: float
    delay: int

    def expert(self, rng: np.random.Generator) -> Scripted:
        """Returns the policy of an episode; ``rng`` draws the noise."""
        return Scripted(self, self.moves, (self.noise, 0.02), rng)

    def moves(self, see: See) -> Moves:
        """Comes down, moves along the table, perhaps back, and up."""
        yield from stay(self.finger, self.delay)
        along = np.array([np.cos(self.angle), np.sin(self.angle), 0])
        across = np.array([-along[1], along[0], 0])
        begin = see().cube - self.start * along + self.miss * across
        begin[2] = TABLE_HEIGHT + self.height
        end = begin + self.length * along
        yield from go(see, begin + np.array([0, 0, 0.05]), self.finger, 1.0, steps=20, near=0.03)
        yield from go(see, begin, self.finger, 1.0, steps=12, near=0.015)
        yield from go(see, end, self.finger, self.speed, steps=30, near=0.01)
        if self.back:
            yield from go(see, begin, self.finger, self.speed, steps=60)
        yield from go(see, end + np.array([0, 0, 0.1]), self.finger, 1.0, steps=60)


def pushes(rng: np.random.Generator, number: int) -> PushManner:
    """Draws a push, whatever the episode's number."""
    return PushManner(
        mode="pushes",
        angle=float(rng.uniform(0, 2 * np.pi)),
        start=float(rng.uniform(0.06, 0.09)),
        miss=float(rng.uniform(-0.05, 0.05)),
        height=float(rng.uniform(0.01, 0.05)),
        length=float(rng.uniform(0.04, 0.2)),
        finger=float(rng.choice([CLOSE, OPEN], p=[CLOSED_SHARE, 1 - CLOSED_SHARE])),
        back=bool(rng.random() < BACK_SHARE),
        speed=float(rng.uniform(0.3, 1.0)),
        noise=float(rng.uniform(0.0, 0.1)),
        delay=int(rng.integers(0, 4)),
    )
