"""A scripted expert for Lift that often fails on purpose, because a world model must see more than success.

Every episode draws a mode and its own manner: in most episodes the expert lifts the cube, in others it drops the cube,
closes the gripper beside or above it, or moves about without a goal.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

MODES = {"lift": 0.55, "drop": 0.16, "near_miss": 0.16, "explore": 0.13}  # mode → probability
SIMPLE = ("lift",)  # modes that a curriculum begins with; the others are difficult
TABLE_HEIGHT = 0.8  # metres
OPEN = -1.0
CLOSE = 1.0
NOISE_MEMORY = 0.8  # correlation of the action noise from one control step to the next
GAIN = 20.0  # action per metre of error: full speed until the goal is within 5 cm of the target
TURN_GAIN = 1.5  # action per radian


@dataclass(frozen=True)
class ArmState:
    """The observation of every expert of the Panda arm: positions in metres in the world, yaws in radians.

    Attributes:
        gripper: position of the gripper.
        goal: position to which the actions so far have sent it.
        gripper_yaw: its turn about the vertical.
    """

    gripper: Float[np.ndarray, " 3"]
    goal: Float[np.ndarray, " 3"]
    gripper_yaw: float


@dataclass(frozen=True)
class LiftState(ArmState):
    """The observation of Lift's expert: the arm, and the cube's position and yaw."""

    cube: Float[np.ndarray, " 3"]
    cube_yaw: float


@dataclass(frozen=True)
class Manner:
    """The expert's behaviour in one episode; lengths in metres, times in control steps.

    Attributes:
        mode: a key of ``MODES``.
        speed: bound on the translation actions, at most 1.
        noise: standard deviation of the noise of the translation actions.
        turn_noise: standard deviation of the noise of the rotation actions.
        delay: steps of standing still at the beginning.
        hover: height above the cube from which the gripper descends.
        offset: from the cube's centre to the point where the gripper closes.
        squeeze: steps from the start of closing to the start of lifting.
        carry: displacement of the cube from where it is grasped.
        release: step after the grasp at which the gripper opens again; -1: never.
    """

    mode: str
    speed: float
    noise: float
    turn_noise: float
    delay: int
    hover: float
    offset: tuple[float, float, float]
    squeeze: int
    carry: tuple[float, float, float]
    release: int


def draw_manner(rng: np.random.Generator) -> Manner:
    """Draws an episode's manner, its mode with the probabilities of ``MODES``."""
    mode = str(rng.choice(list(MODES), p=list(MODES.values())))
    offset = rng.normal(0, 0.004, 3) - np.array([0, 0, 0.004])
    if mode == "near_miss":
        beside = rng.uniform(0.03, 0.06)
        angle = rng.uniform(0, 2 * np.pi)
        if rng.random() < 0.7:
            offset += beside * np.array([np.cos(angle), np.sin(angle), 0])
        else:  # closes above the cube
            offset[2] += rng.uniform(0.035, 0.06)
    return Manner(
        mode=mode,
        speed=float(rng.uniform(0.75, 1.0)),
        noise=float(rng.uniform(0.02, 0.2)),
        turn_noise=float(rng.uniform(0.1, 0.3) if mode == "explore" else rng.uniform(0, 0.06)),
        delay=int(rng.integers(0, 4)),
        hover=float(rng.uniform(0.05, 0.1)),
        offset=tuple(float(x) for x in offset),  # type: ignore[arg-type]
        squeeze=int(rng.integers(5, 8)),
        carry=(float(rng.uniform(-0.04, 0.14)), float(rng.uniform(-0.15, 0.15)), float(rng.uniform(0.08, 0.2))),
        release=int(rng.integers(4, 18)) if mode == "drop" else -1,
    )


class Expert:
    """The policy of one episode: :class:`LiftState` → 7-D action in [-1, 1].

    Args:
        manner: its behaviour.
        rng: generator of the action noise and of aimless motion.
    """

    def __init__(self, manner: Manner, rng: np.random.Generator) -> None:
        self.manner = manner
        self._rng = rng
        self._phase = "hover"
        self._phase_step = 0
        self._step = 0
        self._noise = np.zeros(6)
        self._goal = np.zeros(3)
        self._finger = OPEN
        self._until = 0

    def act(self, state: LiftState) -> Float[np.ndarray, " 7"]:
        """Returns the next action."""
        explores = self.manner.mode == "explore"
        if explores:
            # A random target over or on the table, which changes every half second or so, and a finger action.
            if self._step >= self._until:
                self._until = self._step + int(self._rng.integers(6, 18))
                low = (-0.15, -0.2, TABLE_HEIGHT + 0.015)
                self._goal = self._rng.uniform(low, (0.12, 0.2, TABLE_HEIGHT + 0.25))
                self._finger = OPEN if self._rng.random() < 0.6 else CLOSE
            target = self._goal
            finger = self._finger
        else:
            target, finger = self._pick(state)
        action = np.zeros(7)
        action[:3] = np.clip(GAIN * (target - state.goal), -self.manner.speed, self.manner.speed)
        if not explores and self._phase in ("hover", "descend"):
            action[5] = yaw_action(state)
        if self._step < self.manner.delay:
            action[:] = 0
        scale = np.repeat([self.manner.noise, self.manner.turn_noise], 3)
        self._noise = next_noise(self._noise, scale, self._rng)
        action[:6] += self._noise
        action[6] = finger
        self._step += 1
        return np.clip(action, -1, 1)

    def _enter(self, phase: str) -> None:
        self._phase = phase
        self._phase_step = 0

    def _pick(self, state: LiftState) -> tuple[Float[np.ndarray, " 3"], float]:
        """Returns target and finger action by phase: hover, descend, grasp, carry, release."""
        manner = self.manner
        grasp = state.cube + np.array(manner.offset)
        above = grasp + np.array([0, 0, manner.hover])
        error = above - state.gripper
        if self._phase == "hover" and np.hypot(*error[:2]) < 0.02 and abs(error[2]) < 0.04:
            self._enter("descend")
        elif self._phase == "descend" and (state.gripper[2] < grasp[2] + 0.01 or self._phase_step > 14):
            self._goal = state.gripper.copy()
            self._enter("grasp")
        elif self._phase == "grasp" and self._phase_step >= manner.squeeze:
            self._goal = self._goal + np.array(manner.carry)
            self._enter("carry")
        elif self._phase == "carry" and 0 <= manner.release <= self._phase_step:
            self._goal = state.gripper + np.array([manner.carry[1], manner.carry[0], 0.03])
            self._enter("release")
        self._phase_step += 1
        targets = {"hover": above, "descend": grasp}
        return targets.get(self._phase, self._goal), CLOSE if self._phase in ("grasp", "carry") else OPEN


def yaw_action(state: LiftState, turn: float = 0.0) -> float:
    """Returns the turn about the vertical that brings the fingers to this angle with the cube's sides, in radians."""
    # the cube looks the same after a quarter turn
    error = (state.cube_yaw + turn - state.gripper_yaw + np.pi / 4) % (np.pi / 2) - np.pi / 4
    return float(np.clip(TURN_GAIN * error, -0.5, 0.5))


def next_noise(
    noise: Float[np.ndarray, " 6"], scale: Float[np.ndarray, " 6"], rng: np.random.Generator
) -> Float[np.ndarray, " 6"]:
    """Returns the action noise of the next control step: autoregressive, with standard deviation ``scale``."""
    fresh = np.sqrt(1 - NOISE_MEMORY**2) * scale * rng.standard_normal(6)
    return NOISE_MEMORY * noise + fresh


def skilled_expert(seed: int) -> Expert:
    """Returns a scripted expert that always tries to lift: fast, without noise, and centred on the cube."""
    manner = Manner("lift", 1.0, 0.0, 0.0, 0, 0.06, (0.0, 0.0, -0.004), 6, (0.03, 0.0, 0.15), -1)
    return Expert(manner, np.random.default_rng(seed))
