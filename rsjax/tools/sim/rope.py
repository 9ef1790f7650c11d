"""A rope on a table with the Panda arm, and its rigid twin, a bent rod that nothing but touch tells from the rope.

The rope is a chain of capsules with two hinges between neighbours, one for each direction of bending. The rod is the
same chain, whose hinges have so much inertia that they do not move. Both begin with the same bends and colours.
"""

from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

from rsjax.tools.sim.expert import CLOSE, OPEN, TABLE_HEIGHT, ArmState
from rsjax.tools.sim.panda import PandaSim, table_scene, yaw_of
from rsjax.tools.sim.recipes.script import Moves, Scripted, go, stay, towards
from rsjax.tools.sim.scenery import SEEN, Variation

ROPE = "rope"
ROD = "rod"
LINKS = 11
MIDDLE = LINKS // 2
LENGTH = 0.016  # metres of a link
RADIUS = 0.01  # metres
DENSITY = 700.0  # kg/m³: a link weighs 6 g, with the half spheres at its ends
STIFFNESS = 4e-4  # of a hinge of the rope, N m/rad
DAMPING = 3e-4  # N m s/rad
INERTIA = {ROPE: 2e-5, ROD: 1e4}  # of a hinge, kg m²
LIMIT = 60.0  # degrees by which a hinge can bend
COLOR = "0.85 0.65 0.15 1"
# Our own camera, which sees the whole rope: position and the point it looks at in metres, vertical field of view.
NEAR = ("near", (0.46, 0.46, 1.15), (0.01, 0.0, 0.9), 32.0)
BEND = 0.16  # radians, the greatest bend between neighbours at the start
DIRECTION = 0.5  # radians, the greatest angle at the start to the x-axis, across which the fingers close
PLACE = 0.03  # metres, its greatest distance from the table's centre along each axis at the start
LIFTED = 0.04  # metres above the table of the mean link, from which it is lifted

MODES = {"lift": 0.5, "drop": 0.13, "near_miss": 0.12, "push": 0.13, "explore": 0.12}  # mode → probability
SIMPLE = ("lift",)
TURNING = 0.8  # bound on the action of turning
HOVER = 0.06  # metres above the rope from which the gripper descends
NEAR_ENOUGH = 0.015  # metres
REACHED = 0.003  # metres above the target at which the fingers begin to close
PUSH = 0.12  # metres
# Control steps of hovering and of descending at most, and of closing; the rest of STEPS is for carrying or pushing.
HOVERING = 20
DESCENDING = 16
CLOSING = 9
STEPS = 10**4
LOW = np.array([-0.12, -0.16, TABLE_HEIGHT + 0.03])  # bounds of the targets of aimless motion, metres
HIGH = np.array([0.1, 0.16, TABLE_HEIGHT + 0.2])


@dataclass(frozen=True)
class RopeState(ArmState):
    """The observation of the rope's expert: the arm, the links' centres, and the directions along which they lie."""

    links: Float[np.ndarray, "N 3"]
    yaws: Float[np.ndarray, " N"]


class RopeSim(PandaSim):
    """The rope or the rod on a table, with the actions of :class:`PandaSim`.

    Args:
        task: ``ROPE`` or ``ROD``.
        camera: "near" (our own camera), or the name of one of robosuite's cameras.
        image_size: S, pixels along each side.

    Raises:
        GLError: no OpenGL context can be made.
        ConfigError: there is no such camera.
    """

    def __init__(self, task: str = ROPE, camera: str = "near", image_size: int = 64) -> None:
        super().__init__(
            lambda robosuite, settings: table_scene(robosuite, settings, [], [chain(INERTIA[task])]),
            [f"rope_{number}" for number in range(LINKS)],
            camera,
            NEAR,
            image_size,
        )

    def draw_expert(self, rng: np.random.Generator) -> Scripted:
        """Draws an episode's manner, and returns the expert with it."""
        manner = draw_manner(rng)
        return manner.expert(rng)

    def reset(self, seed: int, variation: Variation = SEEN) -> None:
        """Begins an episode; the seed (0 … 2³² - 1) determines the arm's pose, and place and bends of the rope."""
        import mujoco

        super().reset(seed, variation)
        rng = np.random.default_rng([seed, 1])
        first, last = rng.uniform(-BEND, BEND, 2)
        bends = np.linspace(first, last, LINKS - 1)
        angles = np.append(0.0, np.cumsum(bends))
        angles += rng.uniform(-DIRECTION, DIRECTION) - angles[MIDDLE]
        halves = LENGTH / 2 * np.stack([np.cos(angles), np.sin(angles)], -1)
        centres = np.concatenate([np.zeros((1, 2)), np.cumsum(halves[:-1] + halves[1:], axis=0)])
        place = rng.uniform(-PLACE, PLACE, 2) - centres.mean(0)
        turn = angles[0] / 2
        self._data.joint("rope_free").qpos[:] = [*place, TABLE_HEIGHT + RADIUS, np.cos(turn), 0, 0, np.sin(turn)]
        for number, bend in enumerate(bends, start=1):
            hinge = self._model.joint(f"rope_sideways_{number}").qposadr[0]
            self._data.qpos[hinge] = bend
            self._model.qpos_spring[hinge] = bend
        mujoco.mj_forward(self._model, self._data)

    @property
    def state(self) -> RopeState:
        gripper, rotation = self.gripper
        axes = self._data.xmat[self.object_bodies].reshape(-1, 3, 3)
        return RopeState(
            gripper=gripper,
            goal=self._goal.copy(),
            gripper_yaw=yaw_of(rotation),
            links=self._data.xpos[self.object_bodies].copy(),
            yaws=np.arctan2(axes[:, 1, 0], axes[:, 0, 0]),
        )

    @property
    def success(self) -> bool:
        """Returns whether the mean of the links is more than ``LIFTED`` above the table."""
        return self.object_height > LIFTED

    @property
    def places(self) -> dict[str, Float[np.ndarray, " 3"]]:
        """Returns where the rope's middle and the gripper are, in metres in the world."""
        return {"object": self._data.xpos[self.object_bodies[MIDDLE]].copy(), "gripper": self.gripper[0]}

    @property
    def object_height(self) -> float:
        """Returns the height of the mean of the links above the table in metres."""
        return float(self._data.xpos[self.object_bodies, 2].mean()) - TABLE_HEIGHT

    @property
    def object_width(self) -> float:
        """Returns the rope's thickness in metres."""
        return 2 * RADIUS


def chain(inertia: float) -> ElementTree.Element:
    """Returns the links as nested bodies of MJCF, each with its origin at its capsule's centre.

    Args:
        inertia: that of a hinge beside the links' own, kg m².
    """
    half = LENGTH / 2
    hinge = {
        "type": "hinge",
        "pos": f"{-half} 0 0",
        "armature": str(inertia),
        "stiffness": str(STIFFNESS),
        "damping": str(DAMPING),
        "limited": "true",
        "range": f"{np.radians(-LIMIT)} {np.radians(LIMIT)}",
    }
    capsule = {
        "type": "capsule",
        "fromto": f"{-half} 0 0 {half} 0 0",
        "size": str(RADIUS),
        "rgba": COLOR,
        "group": "1",  # the renderer hides group 0
        "friction": "1.2 0.02 0.001",
        "condim": "4",
        "contype": "2",  # links do not meet each other, as those two apart overlap
        "conaffinity": "1",
    }
    # robosuite takes masses from the geoms of group 0 alone.
    mass = DENSITY * np.pi * (RADIUS**2 * LENGTH + 4 / 3 * RADIUS**3)
    across = mass * (RADIUS**2 / 4 + (LENGTH + RADIUS) ** 2 / 12)
    inertial = {"pos": "0 0 0", "mass": str(mass), "diaginertia": f"{mass * RADIUS**2 / 2} {across} {across}"}
    root = ElementTree.Element("body", name="rope_0", pos=f"0 0 {TABLE_HEIGHT + RADIUS}")
    ElementTree.SubElement(root, "inertial", inertial)
    ElementTree.SubElement(root, "joint", name="rope_free", type="free")
    ElementTree.SubElement(root, "geom", capsule, name="rope_geom_0")
    body = root
    for number in range(1, LINKS):
        body = ElementTree.SubElement(body, "body", name=f"rope_{number}", pos=f"{LENGTH} 0 0")
        ElementTree.SubElement(body, "inertial", inertial)
        ElementTree.SubElement(body, "joint", hinge, name=f"rope_sideways_{number}", axis="0 0 1")
        ElementTree.SubElement(body, "joint", hinge, name=f"rope_upwards_{number}", axis="0 1 0")
        ElementTree.SubElement(body, "geom", capsule, name=f"rope_geom_{number}")
    return root


@dataclass(frozen=True)
class Manner:
    """The expert's behaviour in one episode, drawn without regard to whether it meets the rope or the rod.

    Attributes:
        mode: a key of ``MODES``.
        link: the number of the link that the fingers go to.
        offset: from that link to where they go, across the rope and up, metres.
        speed: bound on the translation actions, at most 1.
        noise: standard deviation of the noise of the translation actions.
        delay: control steps of standing still at the beginning.
        carry: displacement of the closed gripper, metres.
        release: control steps of carrying after which the gripper opens; -1: never.
    """

    mode: str
    link: int
    offset: tuple[float, float]
    speed: float
    noise: float
    delay: int
    carry: tuple[float, float, float]
    release: int

    def expert(self, rng: np.random.Generator) -> Scripted:
        """Returns the policy of an episode."""
        turn_noise = 0.03
        if self.mode == "explore":
            return Scripted(self, lambda see: wander(self, see, rng), (self.noise, 3 * turn_noise), rng)
        return Scripted(self, self.moves, (self.noise, turn_noise), rng)

    def moves(self, see: Any) -> Moves:
        """Turns the fingers across the rope and comes down on it; then carries it, or moves along the table."""
        yield from stay(OPEN, self.delay)
        finger = OPEN
        if self.mode == "push":
            finger = CLOSE
        for _ in range(HOVERING):
            above = self.target(see()) + np.array([0, 0, HOVER])
            if np.abs(see().gripper - above).max() < NEAR_ENOUGH and abs(self.turn(see())) < 0.2:
                break
            yield towards(see(), above, finger, self.speed, np.clip(1.5 * self.turn(see()), -TURNING, TURNING))
        for _ in range(DESCENDING):
            point = self.target(see())
            yield towards(see(), point, finger, self.speed)
            if see().gripper[2] - point[2] < REACHED:
                break
        here = see().gripper.copy()
        here[2] = self.target(see())[2]  # the arm lags behind its goal and goes on coming down
        if self.mode == "push":
            across = see().yaws[self.link] + np.pi / 2
            way = PUSH * np.array([np.cos(across), np.sin(across), 0.0])
            yield from go(see, here - np.sign(self.offset[0]) * way, CLOSE, self.speed, STEPS, NEAR_ENOUGH)
            return
        yield from go(see, here, CLOSE, 1.0, CLOSING)
        if self.release >= 0:
            yield from go(see, here + np.array(self.carry), CLOSE, self.speed, self.release)
            yield from stay(OPEN, STEPS)
        yield from go(see, here + np.array(self.carry), CLOSE, self.speed, STEPS)

    def target(self, state: RopeState) -> Float[np.ndarray, " 3"]:
        """Returns where the fingers go."""
        across = state.yaws[self.link] + np.pi / 2
        sideways = self.offset[0] * np.array([np.cos(across), np.sin(across), 0.0])
        return state.links[self.link] + sideways + np.array([0.0, 0.0, self.offset[1]])

    def turn(self, state: RopeState) -> float:
        """Returns the turn in radians that makes the fingers close across the rope, which half a turn leaves alike."""
        error = state.yaws[self.link] + np.pi / 2 - state.gripper_yaw
        return float((error + np.pi / 2) % np.pi - np.pi / 2)


def draw_manner(rng: np.random.Generator) -> Manner:
    """Draws an episode's manner, its mode with the probabilities of ``MODES``."""
    mode = str(rng.choice(list(MODES), p=list(MODES.values())))
    across = rng.normal(0, 0.003)
    up = rng.normal(-0.002, 0.002)
    side = rng.choice([-1.0, 1.0])
    beside = rng.uniform(0.045, 0.07)
    release = int(rng.integers(6, 18))
    if mode in ("near_miss", "push"):
        across = side * beside
    return Manner(
        mode=mode,
        link=int(rng.integers(1, LINKS - 1)),
        offset=(float(across), float(up)),
        speed=float(rng.uniform(0.75, 1.0)),
        noise=float(rng.uniform(0.02, 0.15)),
        delay=int(rng.integers(0, 4)),
        carry=(float(rng.uniform(-0.05, 0.1)), float(rng.uniform(-0.12, 0.12)), float(rng.uniform(0.1, 0.2))),
        release=release if mode == "drop" else -1,
    )


def wander(manner: Manner, see: Any, rng: np.random.Generator) -> Moves:
    """Moves about without a goal: to a random point every half second or so, with open or closed fingers."""
    finger = OPEN
    while True:
        point = rng.uniform(LOW, HIGH)
        if rng.random() < 0.4:
            finger = CLOSE
        else:
            finger = OPEN
        yield from go(see, point, finger, manner.speed, int(rng.integers(6, 18)))
