"""Paired grasps: the same start and approach, then fingers that close at several distances from the cube.

The position of the fingers alone decides whether a grasp succeeds, since the episodes of a group share everything else:
start, height, turn, times, speed, noise, and what follows the closing. Groups differ in height and in times, because a
model that has seen most grasps at one height, or all without a pause, takes others for misses.

Half of the groups beside the cube part along the camera's line of sight. There a policy errs most, because a picture
hardly shows how far away the fingers are; a model that has seen no such misses lets them succeed.
"""

from dataclasses import dataclass

import numpy as np

from rsjax.tools.sim.expert import CLOSE, OPEN
from rsjax.tools.sim.recipes.script import Moves, Scripted, See, go, hover, sight, stay

# Distances from the cube's centre at which the fingers close, metres: an interval for each episode of a group.
BESIDE = ((0.0, 0.018), (0.02, 0.03), (0.03, 0.04), (0.04, 0.055))
SIGHT = ((0.0, 0.018), (0.02, 0.03), (0.03, 0.055), (0.055, 0.1))  # along the line of sight
ABOVE = ((0.0, 0.018), (0.019, 0.027), (0.027, 0.036), (0.036, 0.06))
GROUP = len(BESIDE)
HEIGHT = (-0.012, 0.024)  # above the cube's centre, up to its edge: where the fingers of a group close beside it
ABOVE_SHARE = 0.25  # of the groups; the others close beside the cube
SIGHT_SHARE = 0.5  # of those that close beside it
AROUND_SIGHT = 0.4  # radians to either side of the line of sight
TURNED_SHARE = 0.5  # of the groups: the fingers are not parallel to the cube's sides
PAUSE = 14  # control steps over the point of closing, at most
STOP_SHARE = 0.5  # of the groups: the fingers close where they have come to, not yet at the point
SHORT = 0.01  # as far above the point, metres; so the point lies lower by this


@dataclass(frozen=True)
class GraspManner:
    """A grasp; lengths in metres, times in control steps.

    Attributes:
        hover: height above the cube's centre at which the episodes of a group part.
        offset: from the cube's centre at that moment to the point where the fingers close.
        turn: angle between the fingers and the cube's sides, radians.
        pause: over the point where the fingers close, before the descent.
        stops: whether the descent stops as the fingers begin to close.
        speed, noise, delay, squeeze: as in :class:`rsjax.tools.sim.expert.Manner`.
        carry: displacement after the fingers have closed.
    """

    mode: str
    hover: float
    offset: tuple[float, float, float]
    turn: float
    pause: int
    stops: bool
    speed: float
    noise: float
    delay: int
    squeeze: int
    carry: tuple[float, float, float]

    def expert(self, rng: np.random.Generator) -> Scripted:
        """Returns the policy of an episode; ``rng`` draws the noise."""
        return Scripted(self, self.moves, (self.noise, 0.02), rng)

    def moves(self, see: See) -> Moves:
        """Approaches, parts from the group, pauses, closes and lifts."""
        yield from stay(OPEN, self.delay)
        yield from hover(see, np.array([0, 0, self.hover]), self.speed, steps=24, turn=self.turn)
        point = see().cube + np.array(self.offset)
        yield from go(see, point + np.array([0, 0, self.hover]), OPEN, self.speed, steps=self.pause)
        yield from go(see, point, OPEN, self.speed, steps=14, near=0.007)
        if self.stops:
            point = see().gripper.copy()
        yield from go(see, point, CLOSE, self.speed, self.squeeze)
        yield from go(see, point + np.array(self.carry), CLOSE, self.speed, steps=60)


def grasps(rng: np.random.Generator, number: int) -> GraspManner:
    """Draws a group of grasps, and returns one of it: its ``offset`` alone depends on the episode's number."""
    angle = rng.uniform(0, 2 * np.pi)
    height = rng.uniform(*HEIGHT)
    stops = bool(rng.random() < STOP_SHARE)
    turned = bool(rng.random() < TURNED_SHARE)
    intervals = np.array(BESIDE)
    if rng.random() < ABOVE_SHARE:
        intervals = np.array(ABOVE)
        direction = np.array([0, 0, 1])
        height = -0.004
    else:
        if rng.random() < SIGHT_SHARE:
            intervals = np.array(SIGHT)
            angle = sight() + rng.choice([0, np.pi]) + rng.uniform(-AROUND_SIGHT, AROUND_SIGHT)
        direction = np.array([np.cos(angle), np.sin(angle), 0])
    height -= SHORT * stops
    distances = rng.uniform(intervals[:, 0], intervals[:, 1])
    x, y, z = distances[number % GROUP] * direction
    return GraspManner(
        mode="grasps",
        hover=float(rng.uniform(0.06, 0.1)),
        offset=(float(x), float(y), float(z + height)),
        turn=float(turned * rng.uniform(-np.pi / 4, np.pi / 4)),
        pause=int(rng.integers(0, PAUSE + 1)),
        stops=stops,
        speed=float(rng.uniform(0.75, 1.0)),
        noise=float(rng.uniform(0.0, 0.1)),
        delay=int(rng.integers(0, 4)),
        squeeze=int(rng.integers(5, 8)),
        carry=(float(rng.uniform(-0.04, 0.1)), float(rng.uniform(-0.1, 0.1)), float(rng.uniform(0.1, 0.2))),
    )
