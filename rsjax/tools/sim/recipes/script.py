"""A scripted policy whose behaviour is a generator: it tells the story of an episode in the order in which it happens.

Lengths are in metres in the world, times in control steps.
"""

from collections.abc import Callable, Iterator
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Float

from rsjax.tools.sim.expert import GAIN, OPEN, ArmState, LiftState, next_noise, yaw_action

See: TypeAlias = Callable[[], LiftState]  # returns the current state
Moves: TypeAlias = Iterator[Float[np.ndarray, " 7"]]  # the action of each control step


class Scripted:
    """The policy of one episode: it follows a script with noise on its motion, and then stands still.

    Args:
        manner: what was drawn for the episode, a dataclass with the recipe's name as ``mode``.
        script: returns the episode's actions, given a function that returns the current state.
        noise: standard deviations of the noise on translation and on rotation.
        rng: generator of the noise.
    """

    def __init__(
        self, manner: Any, script: Callable[[See], Moves], noise: tuple[float, float], rng: np.random.Generator
    ) -> None:
        self.manner = manner
        self._moves = script(lambda: self._state)
        self._scale = np.repeat(noise, 3)
        self._noise = np.zeros(6)
        self._rng = rng
        self._last = rest(OPEN)
        self._state: Any

    def act(self, state: Any) -> Float[np.ndarray, " 7"]:
        """Returns the next action."""
        self._state = state
        action = next(self._moves, rest(self._last[6]))
        self._last = action
        self._noise = next_noise(self._noise, self._scale, self._rng)
        return np.clip(action + np.append(self._noise, 0), -1, 1)


def rest(finger: float) -> Float[np.ndarray, " 7"]:
    """Returns the action that asks for no motion."""
    return np.array([0, 0, 0, 0, 0, 0, finger], float)


def towards(
    state: ArmState, point: Float[np.ndarray, " 3"], finger: float, speed: float = 1.0, turn: float = 0.0
) -> Float[np.ndarray, " 7"]:
    """Returns the action that moves the gripper's goal towards a point.

    Args:
        speed: bound on each number of the translation, at most 1.
        turn: the number that turns the gripper about the vertical.
    """
    action = rest(finger)
    action[:3] = np.clip(GAIN * (point - state.goal), -speed, speed)
    action[5] = turn
    return action


def stay(finger: float, steps: int) -> Moves:
    """Asks for no motion."""
    for _ in range(steps):
        yield rest(finger)


def go(
    see: Callable[[], ArmState],
    point: Float[np.ndarray, " 3"],
    finger: float,
    speed: float,
    steps: int,
    near: float = 0.0,
) -> Moves:
    """Moves towards a point for at most ``steps`` steps, until the gripper is ``near`` it along each axis."""
    for _ in range(steps):
        if np.abs(see().gripper - point).max() < near:
            return
        yield towards(see(), point, finger, speed)


def hover(
    see: See, above: Float[np.ndarray, " 3"], speed: float, steps: int, near: float = 0.02, turn: float = 0.0
) -> Moves:
    """Moves the open gripper to a place relative to the cube for at most ``steps`` steps.

    Args:
        turn: angle between the fingers and the cube's sides, radians.
    """
    for _ in range(steps):
        point = see().cube + above
        if np.abs(see().gripper - point).max() < near:
            return
        yield towards(see(), point, OPEN, speed, yaw_action(see(), turn))
