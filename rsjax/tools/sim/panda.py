"""The Panda arm at a table of robosuite: control steps towards a goal pose, pictures, and the pose of every body."""

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np
from jaxtyping import Float, UInt8

from rsjax.tools.sim.base import MujocoSim, OwnCamera, choose_camera
from rsjax.tools.sim.gl import choose_gl
from rsjax.tools.sim.render import Renderer
from rsjax.tools.sim.scenery import SEEN, Scenery, Variation

CONTROL_HZ = 20
CENTRE = (0.0, 0.0, 0.85)  # of the workspace, metres
STEP = 0.015  # metres by which an action of 1 moves the goal: 0.3 m/s
TURN = 0.15  # radians, likewise
WRIST = "robot0_eye_in_hand"  # robosuite's camera on the hand
REACH = np.array([[-0.35, -0.4, 0.8], [0.3, 0.4, 1.3]])  # bounds of the goal position, metres


class PandaSim(MujocoSim):
    """A scene with the Panda arm: 20 Hz, 7-D actions in [-1, 1] (6-D change of the goal pose, gripper; +1 closes).

    robosuite's OSC_POSE controller pulls the gripper to a goal pose. Its own actions set the goal relative to the
    current pose. The arm always lags behind its goal, so the sum of those actions does not tell where the arm is. Here
    the actions move the goal itself, so that their sum does (notebooks/miniature.md).

    An episode depends only on the arguments of :meth:`reset`. Use as a context manager, or call :meth:`close`: a
    renderer that is freed only when the interpreter exits prints errors.

    Args:
        make: makes robosuite's environment from robosuite and the settings of the arm.
        objects: names of the bodies whose colours may change, and that tracks follow first.
        camera: the name of our own camera, or of one of robosuite's.
        own: our own camera.
        image_size: S, pixels along each side.

    Raises:
        GLError: no OpenGL context can be made.
        ConfigError: there is no such camera.
    """

    def __init__(
        self,
        make: Callable[[Any, dict[str, Any]], Any],
        objects: Sequence[str],
        camera: str,
        own: OwnCamera,
        image_size: int,
    ) -> None:
        robosuite = load_robosuite()
        settings = {
            "robots": "Panda",
            "controller_configs": robosuite.load_controller_config(default_controller="OSC_POSE")
            | {"control_delta": False},
            "has_renderer": False,
            "has_offscreen_renderer": False,
            "use_camera_obs": False,
            "control_freq": CONTROL_HZ,
            "ignore_done": True,
            "hard_reset": False,
        }
        # robosuite draws the objects' sizes when it builds the scene. Without a fixed seed, episodes would depend on
        # the process.
        with global_seed(0):
            self._env = make(robosuite, settings)
        self._model = self._env.sim.model._model
        self._data = self._env.sim.data._data
        compute_states_once(self._env.sim)
        self._camera_id = choose_camera(self._model, camera, own)
        self.object_bodies = np.array([self._model.body(name).id for name in objects], np.int32)
        self._scenery = Scenery(self._model, self._camera_id, self.object_bodies.tolist(), CENTRE)
        self._renderer = Renderer(self._model, self._camera_id, image_size)
        self._image_size = image_size
        self._wrist: Renderer | None = None  # opened when it is needed

    def close(self) -> None:
        """Frees the renderers and the simulation."""
        if self._wrist is not None:
            self._wrist.close()
        super().close()

    def reset(self, seed: int, variation: Variation = SEEN) -> None:
        """Begins an episode; the seed (0 … 2³² - 1) determines the initial poses of the arm and the objects."""
        self._scenery.apply(variation)
        with global_seed(seed):
            self._env.reset()
        self._goal, self._goal_rotation = self.gripper

    def step(self, action: Float[np.ndarray, " 7"]) -> None:
        """Runs one control step of 50 ms.

        Raises:
            ArithmeticError: the simulation diverged.
        """
        from scipy.spatial.transform import Rotation

        self._goal = np.clip(self._goal + STEP * action[:3], *REACH)
        self._goal_rotation = Rotation.from_rotvec(TURN * action[3:6]).as_matrix() @ self._goal_rotation
        turn = Rotation.from_matrix(self._goal_rotation).as_rotvec()
        self._env.step(np.concatenate([self._goal, turn, action[6:]]))
        self.check_stable()

    @property
    def gripper(self) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"]]:
        """Returns the gripper's position in metres and its rotation in the world."""
        site = self._env.robots[0].eef_site_id
        return self._data.site_xpos[site].copy(), self._data.site_xmat[site].reshape(3, 3).copy()

    @property
    def wrist_image(self) -> UInt8[np.ndarray, "S S 3"]:
        """Returns what the hand's camera sees."""
        if self._wrist is None:
            self._wrist = Renderer(self._model, self._model.camera(WRIST).id, self._image_size)
        return self._wrist.render(self._data).rgb

    @property
    def fingers(self) -> Float[np.ndarray, " 2"]:
        """Returns the positions of the two fingers' joints in metres, the first positive, the second negative."""
        return self._data.qpos[self._env.robots[0]._ref_gripper_joint_pos_indexes].copy()

    @property
    def opening(self) -> float:
        """Returns the distance between the gripper's fingers in metres, 0 if it is shut."""
        left, right = self.fingers
        return float(left - right)


def table_scene(
    robosuite: Any, settings: dict[str, Any], objects: Sequence[Any], bodies: Sequence[Element] = ()
) -> Any:
    """Makes an environment of robosuite with a table and these objects on it, wherever :meth:`reset` leaves them.

    Args:
        objects: robosuite's own models of objects.
        bodies: further bodies as MJCF.
    """
    from robosuite.environments.manipulation.single_arm_env import SingleArmEnv
    from robosuite.models.arenas import TableArena
    from robosuite.models.tasks import ManipulationTask

    class TableScene(SingleArmEnv):  # type: ignore[misc]
        def _load_model(self) -> None:
            super()._load_model()
            arena = TableArena(table_offset=(0, 0, 0.8))
            arena.set_origin([0, 0, 0])
            arm = self.robots[0].robot_model
            arm.set_base_xpos(arm.base_xpos_offset["table"](0.8))
            self.model = ManipulationTask(arena, [arm], list(objects))
            self.model.worldbody.extend(bodies)

        def reward(self, action: Any = None) -> float:
            return 0.0

        def _check_success(self) -> bool:
            return False

    return TableScene(**settings)


def yaw_of(rotation: Float[np.ndarray, "3 3"]) -> float:
    """Returns the angle of a rotation's x-axis about the vertical in radians."""
    return float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def load_robosuite() -> Any:
    """Imports robosuite without its advice about private macro files."""
    choose_gl()
    logging.disable(logging.WARNING)
    try:
        import robosuite
    finally:
        logging.disable(logging.NOTSET)
    return robosuite


def compute_states_once(sim: Any) -> None:
    """Makes robosuite's ``sim`` compute the kinematics of each state only once.

    robosuite asks for them before, in and after its controller. A step of MuJoCo consists of the two halves that are
    used here (with every integrator except Runge-Kutta), so the physics stays the same.
    """
    import mujoco

    model = sim.model._model
    data = sim.data._data
    reset = sim.reset
    known = [b""]

    def forward() -> None:
        state = np.concatenate([[data.time], data.qpos, data.qvel]).tobytes()
        if state != known[0]:
            mujoco.mj_step1(model, data)
            known[0] = state

    def step(with_udd: bool = True) -> None:
        forward()
        mujoco.mj_step2(model, data)

    def reset_all() -> None:
        known[0] = b""
        reset()

    sim.forward = forward
    sim.step = step
    sim.reset = reset_all


@contextmanager
def global_seed(seed: int) -> Iterator[None]:
    """Seeds numpy's global generator, from which robosuite draws, and restores it afterwards."""
    state = np.random.get_state()
    np.random.seed(seed)
    try:
        yield
    finally:
        np.random.set_state(state)
