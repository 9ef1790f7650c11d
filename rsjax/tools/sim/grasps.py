"""A scripted grasp at a set offset between fingers and cube, which the offset alone decides.

Grasps from one start differ in nothing but the offset, so a model that shows the same end for all of them has not
looked at where the fingers close.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rsjax.tools.sim.expert import CLOSE, OPEN, State
from rsjax.tools.sim.lift import TURN

GAIN = 20.0  # action per metre of error, as the expert's
TURNING = 0.5  # bound on the action of turning
HOVER = 0.06  # metres above the point of closing
CARRY = (0.03, 0.0, 0.15)  # metres, as far as the closed gripper is moved
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

    def expert(self, rng: np.random.Generator) -> "GraspExpert":
        """Returns the expert of an episode; nothing about a grasp is random."""
        return GraspExpert(self)


class GraspExpert:
    """The policy of one grasp: :class:`State` → 7-D action in [-1, 1]."""

    def __init__(self, manner: Grasp) -> None:
        self.manner = manner
        self._phase = "hover"
        self._step = 0  # of the phase
        self._grasp: Float[np.ndarray, " 3"] | None = None  # where the fingers close, in the world
        self._turn = 0.0  # radians by which the goal is still to be turned

    def act(self, state: State) -> Float[np.ndarray, " 7"]:
        """Returns the next action."""
        if self._grasp is None:
            self._aim(state)
        assert self._grasp is not None
        error = self._grasp - state.gripper
        if self._phase == "hover" and self._step >= HOVERING:
            self._enter("descend")
        elif self._phase == "descend" and (-error[2] < REACHED or self._step >= DESCENDING):
            self._grasp = state.gripper.copy()
            self._enter("close")
        elif self._phase == "close" and self._step >= CLOSING:
            self._grasp = self._grasp + np.array(CARRY)
            self._enter("lift")
        self._step += 1
        target = self._grasp
        if self._phase == "hover":
            target = target + np.array([0, 0, HOVER])
        action = np.zeros(7)
        action[:3] = GAIN * (target - state.goal)
        action[5] = np.clip(self._turn / TURN, -TURNING, TURNING)
        self._turn -= TURN * action[5]
        action[6] = CLOSE if self._phase in ("close", "lift") else OPEN
        return np.clip(action, -1, 1)

    def _aim(self, state: State) -> None:
        """Chooses the point of closing, and the turn after which the fingers are parallel to the cube's sides."""
        self._turn = (state.cube_yaw - state.gripper_yaw + np.pi / 4) % (np.pi / 2) - np.pi / 4
        yaw = state.gripper_yaw + self._turn
        angle = yaw + np.pi / 2 * self.manner.direction  # fingers close along the x-axis of the gripper
        beside = self.manner.offset * np.array([np.cos(angle), np.sin(angle)])
        self._grasp = state.cube + np.array([*beside, self.manner.height])

    def _enter(self, phase: str) -> None:
        self._phase = phase
        self._step = 0
