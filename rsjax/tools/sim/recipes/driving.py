"""Free driving, as a person drives the arm: strokes, reversals, curves, and trips to the workspace's edges.

Like the playground, it holds a control for a whole frame of ``tiny``.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float

from rsjax.tools.sim.expert import CLOSE, OPEN
from rsjax.tools.sim.panda import REACH
from rsjax.tools.sim.recipes.script import Moves, Scripted, See, rest, towards

STYLES = ("strokes", "curves", "edges", "strokes", "visits")
HELD = 4  # control steps for which a control is held
REVERSED = 0.4  # share of the strokes that go back the way the last one came
AXES = np.array([0.28, 0.28, 0.28, 0.04, 0.04, 0.08])  # probability of a stroke along or about each axis
VIEW = np.array([[-0.2, -0.2, 0.8], [0.16, 0.17, 1.0]])  # metres: where the camera "near" shows the whole gripper
TOGGLE = 0.3  # probability that the fingers open or close with a new stroke or target
STEPS = 10_000  # more than an episode has


@dataclass(frozen=True)
class DrivingManner:
    """An episode of free driving.

    Attributes:
        style: strokes holds a key for some frames, often reverses, and comes back into the picture; curves changes
            speed smoothly; edges goes to an edge of the workspace and back; visits goes to the cube and away.
        speed: the largest translation action.
        noise: standard deviation of the noise on translation.
    """

    mode: str
    style: str
    speed: float
    noise: float

    def expert(self, rng: np.random.Generator) -> Scripted:
        """Returns the policy of an episode; ``rng`` draws its strokes or targets, and the noise."""
        moves = MOVES[self.style]
        return Scripted(self, partial(moves, self, rng), (self.noise, self.noise / 3), rng)


def driving(rng: np.random.Generator, number: int) -> DrivingManner:
    """Draws an episode of free driving; its number chooses the style."""
    return DrivingManner(
        mode="driving",
        style=STYLES[number % len(STYLES)],
        speed=float(rng.choice([0.5, 1.0], p=[0.3, 0.7])),
        noise=float(rng.choice([0.0, 0.03])),
    )


def strokes(manner: DrivingManner, rng: np.random.Generator, see: See) -> Moves:
    """Holds one or two keys for one to five frames; turns back where the arm leaves the picture."""
    finger = float(rng.choice([OPEN, CLOSE]))
    stroke = np.zeros(6)
    while True:
        low, high = VIEW
        outside = (see().goal < low).astype(int) - (see().goal > high)
        if outside.any():
            stroke = manner.speed * np.append(outside, np.zeros(3))
        elif stroke.any() and rng.random() < REVERSED:
            stroke = -stroke
        else:
            stroke = np.zeros(6)
            stroke[rng.choice(6, p=AXES)] = rng.choice([-1, 1])
            if rng.random() < 0.3:  # two keys at once
                stroke[rng.integers(3)] = rng.choice([-1, 1])
            stroke *= manner.speed
        finger = _toggled(finger, rng)
        for _ in range(HELD * int(rng.integers(1, 6))):
            yield np.append(stroke, finger)


def curves(manner: DrivingManner, rng: np.random.Generator, see: See) -> Moves:
    """Follows a closed curve in the picture, whose coordinates and turns are sines of time."""
    finger = float(rng.choice([OPEN, CLOSE]))
    period = rng.uniform(30, 100, 6)
    phase = rng.uniform(0, 2 * np.pi, 6)
    turns = rng.uniform(0, 1, 3) * np.array([0.1, 0.1, 0.3])
    for step in range(0, STEPS, HELD):
        if step % (4 * HELD) == 0:
            finger = _toggled(finger, rng)
        wave = np.sin(2 * np.pi * step / period + phase)
        control = towards(see(), VIEW.mean(0) + wave[:3] * np.ptp(VIEW, 0) / 2, finger, manner.speed)
        control[3:6] = turns * wave[3:]
        for _ in range(HELD):
            yield control


def edges(manner: DrivingManner, rng: np.random.Generator, see: See) -> Moves:
    """Goes to a place on an edge of the workspace, back into the picture, and on to another edge."""
    finger = float(rng.choice([OPEN, CLOSE]))
    while True:
        target = rng.uniform(*VIEW)
        axis = int(rng.integers(3))
        target[axis] = REACH[rng.integers(2), axis]
        finger = _toggled(finger, rng)
        yield from _drive(see, target, finger, manner.speed, most=40)
        yield from _drive(see, rng.uniform(*VIEW), finger, manner.speed, most=40)


def visits(manner: DrivingManner, rng: np.random.Generator, see: See) -> Moves:
    """Goes to the cube or close to it, perhaps closes the fingers there, and goes somewhere else."""
    finger = OPEN
    while True:
        beside = rng.normal(0, 0.03, 3) * np.array([1, 1, 0.5])
        yield from _drive(see, see().cube + beside + np.array([0, 0, 0.01]), finger, manner.speed, most=24)
        finger = _toggled(finger, rng)
        for _ in range(HELD * int(rng.integers(0, 3))):
            yield rest(finger)
        finger = _toggled(finger, rng)
        yield from _drive(see, rng.uniform(*VIEW), finger, manner.speed, most=int(rng.integers(8, 25)))


def _drive(see: See, target: Float[np.ndarray, " 3"], finger: float, speed: float, most: int) -> Moves:
    """Drives with controls that are held, until the gripper's goal is at the target, or for ``most`` steps."""
    for _ in range(0, most, HELD):
        control = towards(see(), target, finger, speed)
        control[:3] = np.round(control[:3], 1)
        if not control[:3].any():
            return
        for _ in range(HELD):
            yield control


def _toggled(finger: float, rng: np.random.Generator) -> float:
    if rng.random() < TOGGLE:
        return -finger
    return finger


MOVES = {"strokes": strokes, "curves": curves, "edges": edges, "visits": visits}
