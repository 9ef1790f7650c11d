"""Simulates one episode, in any of the simulators, as a clip with exact depth and tracks."""

import importlib.metadata
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from jaxtyping import Bool, Float, Int32

from rsjax.clip import Clip
from rsjax.config import SimConfig, to_dict
from rsjax.config.metaworld import SIMPLE
from rsjax.config.sim import CONTROLS
from rsjax.data.codec import Record
from rsjax.tools.sim import expert, lift, metaworld, panda, rope, tabletop
from rsjax.tools.sim.render import Camera, View
from rsjax.tools.sim.scenery import SEEN, Change, Variation, draw_variation
from rsjax.tools.sim.tracks import Snapshot, grid_pixels, object_pixels, track

POLICY = "policy"  # mode of an episode in which a trained policy acted
WINDOW = "window"  # in the provenance of a clip: the frame of its episode with which it begins; absent: the first


class Expert(Protocol):
    """A scripted policy with the manner of one episode."""

    @property
    def manner(self) -> Any: ...
    def act(self, state: Any, /) -> Float[np.ndarray, " C"]: ...


class Simulator(Protocol):
    """The interface that an episode needs from a simulator; lengths in metres, in world coordinates."""

    def draw_expert(self, rng: np.random.Generator, /) -> Expert: ...
    def reset(self, seed: int, variation: Variation = ..., /) -> None: ...
    def step(self, action: Float[np.ndarray, " C"], /) -> None: ...
    def render(self) -> View: ...
    def segment(self) -> Int32[np.ndarray, "S S"]: ...
    def body_poses(self) -> tuple[Float[np.ndarray, "bodies 3"], Float[np.ndarray, "bodies 3 3"]]: ...
    def close(self) -> None: ...

    @property
    def state(self) -> Any: ...  # what its expert observes
    @property
    def success(self) -> bool: ...
    @property
    def camera(self) -> Camera: ...
    @property
    def movable(self) -> Bool[np.ndarray, " bodies"]: ...
    @property
    def object_bodies(self) -> Int32[np.ndarray, " N"]: ...
    @property
    def object_width(self) -> float: ...
    @property
    def object_height(self) -> float: ...  # of the main object above the table
    @property
    def opening(self) -> float: ...  # between the gripper's fingers
    @property
    def places(self) -> dict[str, Float[np.ndarray, " 3"]]: ...  # positions of main object and gripper, in this order


class Manner(Protocol):
    """The drawn behaviour of an episode's scripted policy, as a dataclass; ``mode`` names its kind."""

    @property
    def mode(self) -> str: ...
    def expert(self, rng: np.random.Generator, /) -> Expert: ...


@dataclass(frozen=True, eq=False)
class Replay:
    """Recorded actions that an episode repeats instead of following an expert.

    Attributes:
        actions: the actions of a clip; those of frame 0 lead into no frame and are not repeated.
        jitter: standard deviation of the noise added to each number; the sum is clipped to [-1, 1].
        expert: the manner of the clip's expert, as its provenance has it; None: that which the episode's number draws.
    """

    actions: Float[np.ndarray, "T A"]
    jitter: float
    expert: dict[str, Any] | None = None


@dataclass(frozen=True)
class EpisodePlan:
    """Describes one episode to simulate.

    Attributes:
        name: name of the episode's file while a store is collected.
        episode: its number; together with the seed it determines start, noise and everything that no other field sets.
            Episodes with one number and different manners start alike.
        task: the task; empty in Lift.
        change: what looks different from training.
        replay: actions that replace the expert's.
        manner: that of the expert; None: one is drawn.
        seed: replaces the configuration's.
        lead: frames of the episode that pass before the clip's first one.
    """

    name: str
    episode: int
    task: str = ""
    change: Change | None = None
    replay: Replay | None = None
    manner: Manner | None = None
    seed: int | None = None
    lead: int = 0


@dataclass(frozen=True)
class Environment:
    """A value of ``sim.env``.

    Attributes:
        open: opens the simulator of a task with a camera and an image size.
        source: names the simulator and its robot.
        package: the package of the simulator.
        control_hz: control steps a second.
        modes: the probability of each mode of its scripted expert.
        simple: the modes that a curriculum begins with; the others are difficult. In Meta-World tasks decide.
    """

    open: Callable[[str, str, int], Simulator]
    source: str
    package: str
    control_hz: int
    modes: Mapping[str, float]
    simple: tuple[str, ...] = ()


ENVIRONMENTS = {
    "lift": Environment(
        lambda task, camera, size: lift.LiftSim(camera, size),
        "robosuite/Lift/Panda",
        "robosuite",
        panda.CONTROL_HZ,
        expert.MODES,
        expert.SIMPLE,
    ),
    "metaworld": Environment(
        metaworld.MetaworldSim, "metaworld/Sawyer", "metaworld", metaworld.CONTROL_HZ, metaworld.MODES
    ),
    "rope": Environment(rope.RopeSim, "robosuite/Rope/Panda", "robosuite", panda.CONTROL_HZ, rope.MODES, rope.SIMPLE),
    "tabletop": Environment(
        tabletop.TabletopSim,
        "robosuite/Tabletop/Panda",
        "robosuite",
        panda.CONTROL_HZ,
        tabletop.MODES,
        tabletop.SIMPLE,
    ),
}


class Simulators:
    """The simulators of all tasks, of which one is open at a time. Call :meth:`close` when done."""

    def __init__(self, config: SimConfig) -> None:
        self._config = config
        self._task = ""
        self._sim: Simulator | None = None

    def __call__(self, task: str) -> Simulator:
        """Returns the simulator of a task and closes that of any other task."""
        if self._sim is None or task != self._task:
            self.close()
            config = self._config
            self._sim = ENVIRONMENTS[config.env].open(task, config.camera, config.image_size)
            self._task = task
        return self._sim

    def close(self) -> None:
        """Closes the open simulator."""
        if self._sim is not None:
            self._sim.close()
        self._sim = None


def task_of(config: SimConfig, episode: int) -> str:
    """Returns the task of an episode; empty in Lift.

    Successive episodes go through all training tasks in random order, then through all of them in a new order.
    """
    tasks = config.train_tasks
    if not tasks:
        return ""
    order = np.random.default_rng([config.seed, episode // len(tasks), 3]).permutation(len(tasks))
    return tasks[order[episode % len(tasks)]]


def run_episode(sim: Simulator, config: SimConfig, plan: EpisodePlan) -> Clip:
    """Simulates one episode, which depends only on the configuration and the plan.

    Frame 0 is the initial state, or that after ``plan.lead`` frames; ``config.control_steps`` control steps lead to
    each later frame.
    """
    episode = plan.episode
    seed = config.seed
    if plan.seed is not None:
        seed = plan.seed
    rng = np.random.default_rng([seed, episode])
    if plan.change:
        looks = draw_variation(plan.change, np.random.default_rng([seed, episode, 2]))
    else:
        looks = SEEN
    sim.reset(int(rng.integers(2**32)), looks)
    if plan.manner:
        policy = plan.manner.expert(rng)
    else:
        policy = sim.draw_expert(rng)
    act = policy.act
    manner = to_dict(policy.manner)
    if plan.replay:
        act = _replayed(plan.replay, CONTROLS[config.env], np.random.default_rng([seed, episode, 4]))
        manner = plan.replay.expert or manner
    for _ in range(plan.lead * config.control_steps):
        sim.step(np.asarray(act(sim.state), np.float32))  # rounded as recorded ones are
    views = []
    seconds = []
    shots = []
    success = []
    places = []
    heights = []
    openings = []
    actions = np.zeros((config.frames, config.control_steps, CONTROLS[config.env]), np.float32)
    for frame in range(config.frames):
        for step in range(config.control_steps if frame else 0):
            actions[frame, step] = act(sim.state)
            sim.step(actions[frame, step])
        views.append(sim.render())
        shots.append(Snapshot(sim.camera, *sim.body_poses(), views[-1].fine_depth))
        if config.second_view == "wrist":
            assert isinstance(sim, panda.PandaSim)
            seconds.append(sim.wrist_image)
        success.append(sim.success)
        places.append(sim.places)
        heights.append(sim.object_height)
        openings.append(sim.opening)
        if frame == 0:
            bodies = sim.segment()
            own_rng = np.random.default_rng([seed, episode, 1])  # the episode does not depend on where tracks start
            if config.track_points == "grid":
                pixels = grid_pixels(config.image_size, config.tracks, own_rng)
            else:
                pixels = object_pixels(bodies, sim.movable, sim.object_bodies, config.tracks, own_rng)
    tracks, visible = track(pixels, views[0].depth, bodies, shots)
    provenance = {
        "source": source_name(config),
        "seed": seed,
        "episode": episode,
        "camera": config.camera,
        "control_hz": ENVIRONMENTS[config.env].control_hz,
        "expert": manner,
        "objects": _in_the_image(shots, places, sim.object_width) | {"height": heights, "opening": openings},
        "versions": {name: importlib.metadata.version(name) for name in (ENVIRONMENTS[config.env].package, "mujoco")},
    }
    if config.env == "metaworld":
        simple = plan.task in SIMPLE
    else:
        simple = manner["mode"] in ENVIRONMENTS[config.env].simple
    if simple:
        provenance["difficulty"] = "simple"
    else:
        provenance["difficulty"] = "difficult"
    if plan.lead:
        provenance[WINDOW] = plan.lead
    if plan.replay:
        provenance["replay"] = {"jitter": plan.replay.jitter}
    if plan.change:
        provenance["unseen"] = {"what": plan.change} | to_dict(looks)
    second = None
    if seconds:
        second = np.stack(seconds)
    return Clip(
        rgb=np.stack([view.rgb for view in views]),
        depth=np.stack([view.depth for view in views]),
        actions=actions.reshape(config.frames, -1),
        tracks=tracks,
        visible=visible,
        success=np.array(success),
        task=plan.task or (lift.ANY_TASK if plan.change == "color" else lift.TASK),
        provenance=provenance,
        second=second,
    )


def begins_episode(clip: Record) -> bool:
    """Returns whether a clip begins where its episode does, and not in its middle."""
    return not clip["provenance"].get(WINDOW)


def clip_seed(provenance: dict[str, Any]) -> int:
    """Returns the seed with which a simulator's ``reset`` starts where a simulated clip's episode started."""
    return int(np.random.default_rng([provenance["seed"], provenance["episode"]]).integers(2**32))


def source_name(config: SimConfig) -> str:
    """Returns the name of the simulator and its robot."""
    return ENVIRONMENTS[config.env].source


def _replayed(replay: Replay, controls: int, rng: np.random.Generator) -> Callable[[Any], Float[np.ndarray, " C"]]:
    """Returns a policy that repeats recorded actions with jitter and ignores its observations."""
    recorded = replay.actions[1:].reshape(-1, controls)
    steps = iter(np.clip(recorded + replay.jitter * rng.standard_normal(recorded.shape), -1, 1))
    return lambda state: next(steps)


def _in_the_image(
    shots: list[Snapshot], places: list[dict[str, Float[np.ndarray, " 3"]]], width: float
) -> dict[str, Any]:
    """Returns (x, y) of object and gripper in each frame, in the units of tracks, and the object's width in frame 0."""
    names = list(places[0])
    seen = [
        shot.camera.project(np.array([place[name] for name in names]))
        for shot, place in zip(shots, places, strict=True)
    ]
    xy = np.array([where for where, _ in seen])
    distance = float(seen[0][1][0])
    placed = {name: xy[:, k].tolist() for k, name in enumerate(names)}
    return placed | {f"{names[0]}_width": width / (shots[0].camera.extent * distance)}
