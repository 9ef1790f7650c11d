"""Drives the arm as a person with a keyboard does: in strokes, back and forth, to the edges of the workspace.

No demonstration looks like this, so a drive shows where the arm of a model goes under actions of a person.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rsjax.tools.sim.expert import CLOSE, OPEN, TABLE_HEIGHT, LiftState

FRAMES = 60  # of a drive, the first one included
# Bounds of the goal position, metres: what the camera "near" shows of the table, and of the space above it.
WORKSPACE = np.array([[-0.15, -0.15, TABLE_HEIGHT + 0.03], [0.1, 0.15, TABLE_HEIGHT + 0.2]])
LENGTH = (8, 28)  # control steps of a stroke
SPEED = (0.5, 1.0)  # of a stroke
SMOOTH = 0.3  # share of the way to the stroke's action in each step
REVERSES = 0.35  # probability that a stroke takes back the one before
TURNS = 0.15  # probability that a stroke also turns the gripper about the vertical
TURN = 0.2  # action of such a turn, either way
GRIPS = 0.3  # probability that a stroke begins with opening or closing the gripper


@dataclass(frozen=True)
class Drive:
    """The manner of a drive; its strokes are drawn as it goes."""

    mode: str = "drive"

    def expert(self, rng: np.random.Generator) -> "Driver":
        """Returns the driver of an episode."""
        return Driver(self, rng)


class Driver:
    """The policy of one drive: :class:`State` → 7-D action in [-1, 1].

    Args:
        rng: draws the strokes.
    """

    def __init__(self, manner: Drive, rng: np.random.Generator) -> None:
        self.manner = manner
        self._rng = rng
        self._stroke = np.zeros(6)
        self._action = np.zeros(7)
        self._action[6] = OPEN
        self._left = 0  # control steps of the stroke

    def act(self, state: LiftState) -> Float[np.ndarray, " 7"]:
        """Returns the next action."""
        rng = self._rng
        if self._left == 0:  # a new stroke: along one, two or three of the axes, or the last stroke reversed
            if self._stroke.any() and rng.random() < REVERSES:
                self._stroke = -self._stroke
            else:
                direction = np.zeros(3)
                while not direction.any():
                    direction = rng.integers(-1, 2, 3).astype(float)
                self._stroke = np.append(rng.uniform(*SPEED) * direction, np.zeros(3))
                if rng.random() < TURNS:
                    self._stroke[5] = rng.choice([-TURN, TURN])
            if rng.random() < GRIPS:
                self._action[6] = CLOSE if self._action[6] == OPEN else OPEN
            self._left = int(rng.integers(*LENGTH, endpoint=True))
        self._left -= 1
        low, high = WORKSPACE
        leaves = ((state.goal <= low) & (self._stroke[:3] < 0)) | ((state.goal >= high) & (self._stroke[:3] > 0))
        self._stroke[:3] = np.where(leaves, -self._stroke[:3], self._stroke[:3])
        self._action[:6] += SMOOTH * (self._stroke - self._action[:6])
        return self._action.copy()
