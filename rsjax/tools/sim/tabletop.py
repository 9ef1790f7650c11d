"""Several objects and a basket before the Panda arm, as in LIBERO: an instruction says which object goes in it.

Robot, controls and state are those of LIBERO's data sets, except that here the actions move the goal (``panda.py``).
"""

from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

from rsjax.config.sim import TABLETOP_TASKS
from rsjax.tools.sim.expert import CLOSE, OPEN, TABLE_HEIGHT, ArmState
from rsjax.tools.sim.panda import TURN, PandaSim, table_scene, yaw_of
from rsjax.tools.sim.recipes.script import Moves, Scripted, go, rest, stay, towards
from rsjax.tools.sim.scenery import SEEN, Variation

# task → its object in words
OBJECTS = dict(zip(TABLETOP_TASKS, ("red cube", "soda can", "bread", "milk carton"), strict=True))
# Our own camera: position and the point it looks at in metres, vertical field of view in degrees.
NEAR = ("near", (0.85, 0.05, 1.35), (-0.02, 0.02, 0.86), 40.0)
BASKET = np.array([0.0, 0.2])  # its place on the table, metres
INSIDE = 0.085  # metres, half of its inner side
WALL = 0.03  # metres, the height of its sides
LOW = np.array([-0.14, -0.24])  # bounds of the objects' places, metres
HIGH = np.array([0.12, 0.05])
APART = 0.11  # metres, the least distance between two objects
SETTLE = 10  # control steps at the start, in which objects come to rest, as in LIBERO
OPENED = 0.06  # metres between the fingers from which they hold nothing

MODES = {"place": 0.7, "wrong": 0.15, "miss": 0.15}  # mode → probability
SIMPLE = ("place",)
SPEED = (0.85, 1.0)
TURNING = 0.8  # bound on the action of turning
NEAR_ENOUGH = 0.015  # metres
HIGH_ENOUGH = 0.2  # metres by which an object is lifted, so that it passes over the others
STEPS = 150  # control steps of a demonstration at most


@dataclass(frozen=True)
class TabletopState(ArmState):
    """The observation of the expert: the arm, and of each object its position, yaw and top, in metres and radians."""

    objects: Float[np.ndarray, "N 3"]
    yaws: Float[np.ndarray, " N"]
    tops: Float[np.ndarray, " N"]


class TabletopSim(PandaSim):
    """The objects and the basket, with the actions of :class:`PandaSim`.

    Args:
        task: a key of ``OBJECTS``; it may be set anew before a reset.
        camera: "near" (our own camera), or the name of one of robosuite's cameras.
        image_size: S, pixels along each side.

    Raises:
        GLError: no OpenGL context can be made.
        ConfigError: there is no such camera.
    """

    def __init__(self, task: str = "cube", camera: str = "near", image_size: int = 64) -> None:
        self.task = task
        self._sizes: list[tuple[float, float]] = []  # from each object's origin to where it is put, and to its top
        self._resting = np.zeros(len(OBJECTS))  # heights of the objects' origins when the episode begins
        super().__init__(self.scene, [f"{name}_main" for name in OBJECTS], camera, NEAR, image_size)

    def scene(self, robosuite: Any, settings: dict[str, Any]) -> Any:
        """Makes robosuite's environment, and notes the objects' heights."""
        from robosuite.models import objects

        things = [
            objects.BoxObject("cube", size=[0.021, 0.021, 0.021], rgba=[0.8, 0.1, 0.1, 1]),
            objects.CanObject("can"),
            objects.BreadObject("bread"),
            objects.MilkObject("milk"),
        ]
        self._sizes = [(float(thing.bottom_offset[2]), float(thing.top_offset[2])) for thing in things]
        return table_scene(robosuite, settings, things, [basket()])

    def draw_expert(self, rng: np.random.Generator) -> Scripted:
        """Draws an episode's manner, and returns the expert with it."""
        return draw_manner(rng, list(OBJECTS).index(self.task)).expert(rng)

    def reset(self, seed: int, variation: Variation = SEEN) -> None:
        """Begins an episode; the seed (0 … 2³² - 1) determines the arm's pose and the places of all objects."""
        import mujoco

        super().reset(seed, variation)
        rng = np.random.default_rng([seed, 2])
        places = scattered(rng, len(OBJECTS))
        for name, place, (bottom, _) in zip(OBJECTS, places, self._sizes, strict=True):
            turn = rng.uniform(-np.pi / 8, np.pi / 8)  # half of the yaw
            height = TABLE_HEIGHT - bottom + 0.003
            self._data.joint(f"{name}_joint0").qpos[:] = [*place, height, np.cos(turn), 0, 0, np.sin(turn)]
        mujoco.mj_forward(self._model, self._data)
        for _ in range(SETTLE):
            self.step(rest(OPEN))
        self._resting = self._data.xpos[self.object_bodies, 2].copy()

    @property
    def state(self) -> TabletopState:
        gripper, rotation = self.gripper
        axes = self._data.xmat[self.object_bodies].reshape(-1, 3, 3)
        places = self._data.xpos[self.object_bodies].copy()
        return TabletopState(
            gripper=gripper,
            goal=self._goal.copy(),
            gripper_yaw=yaw_of(rotation),
            objects=places,
            yaws=np.arctan2(axes[:, 1, 0], axes[:, 0, 0]),
            tops=places[:, 2] + np.array([top for _, top in self._sizes]),
        )

    @property
    def instruction(self) -> str:
        """Returns the task in words."""
        return f"pick up the {OBJECTS[self.task]} and place it in the basket"

    @property
    def success(self) -> bool:
        """Returns whether the task's object lies in the basket and the fingers are open."""
        place = self.places["object"]
        inside = np.abs(place[:2] - BASKET).max() < INSIDE and self.object_height < WALL
        return bool(inside and self.opening > OPENED)

    @property
    def places(self) -> dict[str, Float[np.ndarray, " 3"]]:
        """Returns where the task's object and the gripper are, in metres in the world."""
        body = self.object_bodies[list(OBJECTS).index(self.task)]
        return {"object": self._data.xpos[body].copy(), "gripper": self.gripper[0]}

    @property
    def object_height(self) -> float:
        """Returns the height of the task's object above its place on the table in metres."""
        return float(self.places["object"][2] - self._resting[list(OBJECTS).index(self.task)])

    @property
    def object_width(self) -> float:
        """Returns 5 cm, the width of a can."""
        return 0.05

    @property
    def robot_state(self) -> Float[np.ndarray, " 8"]:
        """Returns LIBERO's state: the hand's position (metres) and axis-angle, and the fingers' joints (metres)."""
        from scipy.spatial.transform import Rotation

        w, x, y, z = self._data.body(self._env.robots[0].robot_model.eef_name).xquat
        turn = Rotation.from_quat([x, y, z, w]).as_rotvec()
        return np.concatenate([self.gripper[0], turn, self.fingers]).astype(np.float32)


def scattered(rng: np.random.Generator, count: int) -> Float[np.ndarray, "N 2"]:
    """Draws places that are ``APART`` from one another."""
    while True:
        places = rng.uniform(LOW, HIGH, (count, 2))
        distances = np.linalg.norm(places[:, None] - places, axis=-1) + APART * np.eye(count)
        if distances.min() >= APART:
            return places


def basket() -> ElementTree.Element:
    """Returns the basket as MJCF: a floor and four walls, which do not move."""
    thick = 0.004
    side = INSIDE + thick
    boxes = {
        "floor": ((0.0, 0.0, thick / 2), (side, side, thick / 2)),
        "left": ((0.0, -side, WALL / 2), (side, thick, WALL / 2)),
        "right": ((0.0, side, WALL / 2), (side, thick, WALL / 2)),
        "back": ((-side, 0.0, WALL / 2), (thick, side, WALL / 2)),
        "front": ((side, 0.0, WALL / 2), (thick, side, WALL / 2)),
    }
    body = ElementTree.Element("body", name="basket", pos=f"{BASKET[0]} {BASKET[1]} {TABLE_HEIGHT}")
    for name, (place, half) in boxes.items():
        shape = {"type": "box", "pos": " ".join(map(str, place)), "size": " ".join(map(str, half))}
        ElementTree.SubElement(
            body, "geom", shape, name=f"basket_{name}", rgba="0.55 0.38 0.2 1", group="1"
        )  # the renderer hides group 0
    return body


@dataclass(frozen=True)
class Manner:
    """The expert's behaviour in one episode.

    Attributes:
        mode: a key of ``MODES``: "wrong" takes another object, "miss" closes beside it.
        target: the number of the object that the fingers go to.
        offset: from that object's centre to where they close, metres.
        speed: bound on the translation actions, at most 1.
        noise: standard deviation of the noise of the translation actions.
        delay: control steps of standing still at the beginning.
        drop: from the basket's centre to where they open, metres.
    """

    mode: str
    target: int
    offset: tuple[float, float]
    speed: float
    noise: float
    delay: int
    drop: tuple[float, float]

    def expert(self, rng: np.random.Generator) -> Scripted:
        """Returns the policy of an episode."""
        return Scripted(self, self.moves, (self.noise, 0.01), rng)

    def moves(self, see: Any) -> Moves:
        """Comes down on the object, closes, carries it to the basket, opens, and rises."""
        yield from stay(OPEN, self.delay)
        for _ in range(30):
            above = self.grasp(see())
            above[2] = see().tops[self.target] + 0.05
            if np.abs(see().gripper - above).max() < NEAR_ENOUGH and abs(self.turn(see())) < 0.1:
                break
            yield towards(see(), above, OPEN, self.speed, np.clip(self.turn(see()) / TURN, -TURNING, TURNING))
        for _ in range(18):
            point = self.grasp(see())
            yield towards(see(), point, OPEN, self.speed)
            if see().gripper[2] - point[2] < 0.008:
                break
        closed = see().gripper.copy()
        yield from go(see, closed, CLOSE, 1.0, 8)
        yield from go(see, closed + np.array([0.0, 0.0, HIGH_ENOUGH]), CLOSE, self.speed, 20, NEAR_ENOUGH)
        over = np.append(BASKET + np.array(self.drop), closed[2] + HIGH_ENOUGH)
        yield from go(see, over, CLOSE, self.speed, 40, NEAR_ENOUGH)
        down = np.append(over[:2], closed[2] + 0.02)
        yield from go(see, down, CLOSE, self.speed, 20, NEAR_ENOUGH)
        yield from go(see, see().gripper.copy(), OPEN, 1.0, 5)
        yield from go(see, over, OPEN, self.speed, STEPS)

    def grasp(self, state: TabletopState) -> Float[np.ndarray, " 3"]:
        """Returns where the fingers close: at the object's centre, or 3 cm below its top if it is tall."""
        point = state.objects[self.target] + np.append(self.offset, 0.0)
        point[2] = max(point[2], state.tops[self.target] - 0.03)
        return point

    def turn(self, state: TabletopState) -> float:
        """Returns the turn in radians that makes the fingers parallel to the object's sides, a quarter turn apart."""
        error = state.yaws[self.target] - state.gripper_yaw
        return float((error + np.pi / 4) % (np.pi / 2) - np.pi / 4)


def draw_manner(rng: np.random.Generator, target: int) -> Manner:
    """Draws an episode's manner for the object of this number, its mode with the probabilities of ``MODES``."""
    mode = str(rng.choice(list(MODES), p=list(MODES.values())))
    offset = rng.normal(0, 0.003, 2)
    angle = rng.uniform(0, 2 * np.pi)
    beside = rng.uniform(0.06, 0.09)
    other = int((target + rng.integers(1, len(OBJECTS))) % len(OBJECTS))
    if mode == "miss":
        offset = offset + beside * np.array([np.cos(angle), np.sin(angle)])
    return Manner(
        mode=mode,
        target=other if mode == "wrong" else target,
        offset=(float(offset[0]), float(offset[1])),
        speed=float(rng.uniform(*SPEED)),
        noise=float(rng.uniform(0.0, 0.08)),
        delay=int(rng.integers(0, 4)),
        drop=(float(rng.uniform(-0.02, 0.02)), float(rng.uniform(-0.02, 0.02))),
    )


def demonstration(rng: np.random.Generator, task: str) -> Manner:
    """Draws the manner of an episode that is meant to succeed."""
    while (manner := draw_manner(rng, list(OBJECTS).index(task))).mode != "place":
        pass
    return manner
