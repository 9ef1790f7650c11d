"""A scripted grasp at a set offset between fingers and cube, which the offset alone decides.

Grasps from one start differ in nothing but the offset, so a model that shows the same end for all of them has not
looked at where the fingers close.
"""

from dataclasses import dataclass

import numpy as np

from rsjax.tools.sim.expert import CLOSE, OPEN
from rsjax.tools.sim.panda import TURN
from rsjax.tools.sim.recipes.script import Moves, Scripted, See, go, towards

TURNING = 0.5  # bound on the action of turning
HOVER = np.array([0.0, 0.0, 0.06])  # metres from the point of closing
CARRY = np.array([0.03, 0.0, 0.15])  # metres, as far as the closed gripper is moved
REACHED = 0.004  # metres above the point at which the fingers begin to close
# Control steps of hovering, of descending (at most), and of closing. The rest of STEPS is for lifting.
HOVERING = 22
DESCENDING = 12
CLOSING = 7
STEPS = 60  # control steps of a grasp: 3 seconds


@dataclass(frozen=True)
class Grasp:
    """The manner of a grasp.

    Attributes:
        offset: horizontal distance from the cube's centre to the point where the fingers close, metres.
        direction: of the offset in quarter turns: 0 and 2 are on the line on which the fingers close.
        height: of that point above the cube's centre, metres.
    """

    offset: float
    direction: int
    height: float
    mode: str = "grasp"

    def expert(self, rng: np.random.Generator) -> Scripted:
        """Returns the policy of an episode; nothing about a grasp is random."""
        return Scripted(self, self.moves, (0.0, 0.0), rng)

    def moves(self, see: See) -> Moves:
        """Turns the fingers parallel to the cube's sides over the point of closing, descends, closes and lifts."""
        begin = see()
        turn = (begin.cube_yaw - begin.gripper_yaw + np.pi / 4) % (np.pi / 2) - np.pi / 4
        angle = begin.gripper_yaw + turn + np.pi / 2 * self.direction  # fingers close along the x-axis of the gripper
        point = begin.cube + np.array([self.offset * np.cos(angle), self.offset * np.sin(angle), self.height])
        for _ in range(HOVERING):
            action = towards(see(), point + HOVER, OPEN)
            action[5] = np.clip(turn / TURN, -TURNING, TURNING)
            turn -= TURN * action[5]
            yield action
        for _ in range(DESCENDING):
            yield towards(see(), point, OPEN)
            if see().gripper[2] - point[2] < REACHED:
                break
        closed = see().gripper.copy()
        yield from go(see, closed, CLOSE, speed=1.0, steps=CLOSING)
        yield from go(see, closed + CARRY, CLOSE, speed=1.0, steps=STEPS)
