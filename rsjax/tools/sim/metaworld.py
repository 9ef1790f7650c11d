"""Meta-World's tasks with the Sawyer arm: control steps, pictures, the exact pose of every body, scripted experts."""

import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int32

from rsjax.errors import UserError
from rsjax.tools.sim.base import MujocoSim, choose_camera
from rsjax.tools.sim.gl import choose_gl
from rsjax.tools.sim.render import Renderer
from rsjax.tools.sim.scenery import SEEN, Scenery, Variation

CONTROL_HZ = 80
CENTRE = (0.0, 0.66, 0.1)  # of the workspace, metres
# Our own camera, which sees no sky: position and the point it looks at in metres, vertical field of view in degrees.
NEAR = ("near", (0.96, 0.07, 1.36), (0.0, 0.66, 0.13), 28.0)
MOST_OPENING = 0.1  # metres between the fingers that Meta-World observes as 1, its greatest value
OBJECT_WIDTH = 0.05  # metres, the size of a puck or handle; the unit for errors of the object's place
STEPS = 10**9  # limit of an episode; after its own limit of 500 steps Meta-World raises an error

MODES = {"expert": 0.6, "interrupted": 0.2, "explore": 0.2}  # mode → probability
NOISE_MEMORY = 0.95  # correlation of the action noise from one control step to the next
REACH = ((-0.3, 0.45, 0.06), (0.25, 0.85, 0.3))  # bounds of the targets of aimless motion, metres
GAIN = 10.0  # action per metre of error


class MetaworldError(UserError):
    """Meta-World cannot be used. The message says how to install it."""


def load_metaworld() -> tuple[Any, Any]:
    """Imports Meta-World and returns its environments and policies by name.

    Raises:
        GLError: there is no OpenGL library.
        MetaworldError: it is not installed.
    """
    choose_gl()
    try:
        from metaworld.env_dict import ALL_V3_ENVIRONMENTS
        from metaworld.policies import ENV_POLICY_MAP
    except ImportError as error:
        raise MetaworldError(
            f"Meta-World cannot be imported ({error}); make setup installs it, or pip install metaworld==3.1.1"
        ) from error
    return ALL_V3_ENVIRONMENTS, ENV_POLICY_MAP


class MetaworldSim(MujocoSim):
    """A task of Meta-World: 80 Hz, 4-D actions in [-1, 1] (position delta of up to 1 cm an axis, gripper; +1 closes).

    An episode depends only on the arguments of :meth:`reset`. Use as a context manager, or call :meth:`close`.

    Args:
        task: one of :data:`rsjax.config.metaworld.TASKS`.
        camera: "near" (our own camera), or the name of one of Meta-World's cameras.
        image_size: S, pixels along each side.

    Raises:
        MetaworldError: Meta-World is not installed.
        GLError: no OpenGL context can be made.
        ConfigError: there is no such camera.
    """

    def __init__(self, task: str, camera: str = "near", image_size: int = 64) -> None:
        environments, policies = load_metaworld()
        self.task = task
        self._env = environments[f"{task}-v3"]()
        self.policy = policies[f"{task}-v3"]()
        self._env.max_path_length = STEPS
        self._env._set_task_called = True
        self._env.seeded_rand_vec = True
        self._env._partially_observable = False  # the experts look for the goal in the observation,
        del self._env.sawyer_observation_space  # which is clipped to this space
        self._model = self._env.model
        self._data = self._env.data
        self._camera_id = choose_camera(self._model, camera, NEAR)
        roots = self._model.body_rootid
        arm = self._model.body_rootid[self._model.body("hand").id]
        self.object_bodies: Int32[np.ndarray, " N"] = np.flatnonzero(self.movable & (roots != arm)).astype(np.int32)
        self._scenery = Scenery(self._model, self._camera_id, self.object_bodies.tolist(), CENTRE)
        self._renderer = Renderer(self._model, self._camera_id, image_size, hidden=())
        self.state: Float[np.ndarray, " 39"] = np.zeros(39)
        self.success = False

    def draw_expert(self, rng: np.random.Generator) -> "Expert":
        """Draws an episode's manner, and returns the task's expert with it."""
        return Expert(self.policy, draw_manner(rng), rng)

    def reset(self, seed: int, variation: Variation = SEEN) -> None:
        """Begins an episode; the seed (0 … 2³² - 1) determines the positions of the objects and the goal."""
        import mujoco

        self._scenery.apply(variation)
        mujoco.mj_resetData(self._model, self._data)
        self._env._freeze_rand_vec = False
        self._env.seed(seed)
        self._env.reset()
        self._env._freeze_rand_vec = True  # the next reset computes goals from where the first one put the objects
        self._env.reset()
        mujoco.mj_forward(self._model, self._data)
        self.state = self._env._get_obs()
        self.success = bool(self._env.evaluate_state(self.state, np.zeros(4, np.float32))[1]["success"])

    def step(self, action: Float[np.ndarray, " 4"]) -> None:
        """Runs one control step of 12.5 ms.

        Raises:
            ArithmeticError: the simulation diverged.
        """
        self.state, _, _, _, info = self._env.step(action)
        self.success = bool(info["success"])
        self.check_stable()

    @property
    def places(self) -> dict[str, Float[np.ndarray, " 3"]]:
        """Returns where the main object and the gripper are, in metres in the world."""
        return {"object": np.array(self._env._get_pos_objects()[:3]), "gripper": np.array(self._env.tcp_center)}

    @property
    def object_height(self) -> float:
        """Returns the height of the main object above the table in metres."""
        return float(self._env._get_pos_objects()[2])

    @property
    def opening(self) -> float:
        """Returns the distance between the gripper's fingers in metres, at most ``MOST_OPENING``."""
        return MOST_OPENING * float(self.state[3])

    @property
    def object_width(self) -> float:
        return OBJECT_WIDTH


@dataclass(frozen=True)
class Manner:
    """The expert's behaviour in one episode; times in control steps.

    Attributes:
        mode: a key of ``MODES``.
        noise: standard deviation of the noise of the position actions.
        delay: steps of standing still at the beginning.
        leave: step at which aimless motion begins; -1: never.
    """

    mode: str
    noise: float
    delay: int
    leave: int


def draw_manner(rng: np.random.Generator) -> Manner:
    """Draws an episode's manner, its mode with the probabilities of ``MODES``."""
    mode = str(rng.choice(list(MODES), p=list(MODES.values())))
    noise = float(rng.uniform(0.02, 0.15))
    delay = int(rng.integers(0, 8))
    leave = int(rng.integers(30, 80))
    return Manner(mode, noise, delay, {"expert": -1, "explore": 0}.get(mode, leave))


class Expert:
    """The policy of one episode: Meta-World's own expert with noise, or aimless motion.

    Args:
        policy: Meta-World's policy.
        manner: its behaviour.
        rng: generator of the noise and of aimless motion.
    """

    def __init__(self, policy: Any, manner: Manner, rng: np.random.Generator) -> None:
        self._policy = policy
        self.manner = manner
        self._rng = rng
        self._noise = np.zeros(3)
        self._goal = np.zeros(3)
        self._finger = -1.0
        self._step = 0
        self._until = 0

    def act(self, state: Float[np.ndarray, " 39"]) -> Float[np.ndarray, " 4"]:
        """Returns the next action."""
        if 0 <= self.manner.leave <= self._step:
            if self._step >= self._until:  # a random target, which changes every third of a second or so
                self._until = self._step + int(self._rng.integers(20, 45))
                self._goal = self._rng.uniform(*REACH)
                self._finger = 1.0 if self._rng.random() < 0.4 else -1.0
            action = np.append(np.clip(GAIN * (self._goal - state[:3]), -1, 1), self._finger)
        else:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # the policy warns that actions will be clipped
                action = np.clip(np.array(self._policy.get_action(state), np.float64), -1, 1)
        if self._step < self.manner.delay:
            action[:3] = 0
        fresh = np.sqrt(1 - NOISE_MEMORY**2) * self.manner.noise * self._rng.standard_normal(3)
        self._noise = NOISE_MEMORY * self._noise + fresh
        action[:3] += self._noise
        self._step += 1
        return np.clip(action, -1, 1)
