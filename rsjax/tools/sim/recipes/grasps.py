"""Paired grasps: the same start and approach, then fingers that close at several distances from the cube.

The position of the fingers alone decides whether a grasp succeeds, since the episodes of a group share everything else:
start, height, turn, times, speed, noise, and what follows the closing. Groups differ in height and in times, because a
model that has seen most grasps at one height, or all without a pause, takes others for misses.

In half of the groups the gripper turns aside over the cube. In the others the expert itself errs about the cube, and
goes to the wrong place directly, as a policy does that learned from it. Without these, a model can tell most misses by
their manner, and lets such a policy's misses succeed.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from rsjax.tools.sim.expert import CLOSE, OPEN, Expert, LiftState, Manner
from rsjax.tools.sim.recipes.script import Moves, Scripted, See, go, hover, stay

# Distances from the cube's centre at which the fingers close, metres: an interval for each episode of a group.
BESIDE = ((0.0, 0.018), (0.02, 0.03), (0.03, 0.055), (0.055, 0.1))
ABOVE = ((0.0, 0.018), (0.019, 0.027), (0.027, 0.036), (0.036, 0.06))
GROUP = len(BESIDE)
HEIGHT = (-0.012, 0.024)  # above the cube's centre, up to its edge: where the fingers of a group close beside it
ABOVE_SHARE = 0.25  # of the groups; the others close beside the cube
MISTAKEN_SHARE = 0.5  # of the groups: the expert errs
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


@dataclass(frozen=True)
class MistakenManner(Manner):
    """The expert's manner, with an error about the cube.

    Attributes:
        offset: from the cube's centre to the point where the fingers close, the error included.
        turn: by how much it errs about the cube's turn, radians.
    """

    turn: float

    def expert(self, rng: np.random.Generator) -> Expert:
        """Returns the policy of an episode; ``rng`` draws the noise."""
        return Mistaken(self, rng)


class Mistaken(Expert):
    """The expert, which sees the cube turned."""

    manner: MistakenManner

    def act(self, state: LiftState) -> Float[np.ndarray, " 7"]:
        """Returns the next action."""
        return super().act(replace(state, cube_yaw=state.cube_yaw + self.manner.turn))


def grasps(rng: np.random.Generator, number: int) -> GraspManner | MistakenManner:
    """Draws a group of grasps, and returns one of it: its ``offset`` alone depends on the episode's number."""
    mistaken = rng.random() < MISTAKEN_SHARE
    stops = mistaken or bool(rng.random() < STOP_SHARE)
    intervals = np.array(BESIDE)
    angle = rng.uniform(0, 2 * np.pi)
    direction = np.array([np.cos(angle), np.sin(angle), 0])
    height = rng.uniform(*HEIGHT)
    if rng.random() < ABOVE_SHARE:
        intervals = np.array(ABOVE)
        direction = np.array([0, 0, 1])
        height = -0.004
    distances = rng.uniform(intervals[:, 0], intervals[:, 1])
    x, y, z = distances[number % GROUP] * direction
    offset = (float(x), float(y), float(z + height - SHORT * stops))
    turn = float(rng.choice([0, rng.uniform(-np.pi / 4, np.pi / 4)]))
    carry = (float(rng.uniform(-0.04, 0.1)), float(rng.uniform(-0.1, 0.1)), float(rng.uniform(0.1, 0.2)))
    speed = float(rng.uniform(0.75, 1.0))
    noise = float(rng.uniform(0.0, 0.1))
    delay = int(rng.integers(0, 4))
    squeeze = int(rng.integers(5, 8))
    above = float(rng.uniform(0.06, 0.1))
    if mistaken:
        return MistakenManner(
            mode="grasps",
            speed=speed,
            noise=2 * noise,  # up to 0.2, as the expert's
            turn_noise=0.02,
            delay=delay,
            hover=above,
            offset=offset,
            squeeze=squeeze,
            carry=carry,
            release=-1,
            turn=turn,
        )
    return GraspManner(
        mode="grasps",
        hover=above,
        offset=offset,
        turn=turn,
        pause=int(rng.integers(0, PAUSE + 1)),
        stops=stops,
        speed=speed,
        noise=noise,
        delay=delay,
        squeeze=squeeze,
        carry=carry,
    )
