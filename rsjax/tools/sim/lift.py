"""robosuite's Lift with the Panda arm: control steps, pictures, and the exact pose of every body."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from jaxtyping import Float, Int32

from rsjax.tools.sim.base import MujocoSim, choose_camera
from rsjax.tools.sim.expert import TABLE_HEIGHT, Expert, State, draw_manner
from rsjax.tools.sim.gl import choose_gl
from rsjax.tools.sim.render import Renderer
from rsjax.tools.sim.scenery import SEEN, Scenery, Variation

TASK = "lift the red cube"
ANY_TASK = "lift the cube"  # the task where the cube has another colour
CENTRE = (0.0, 0.0, 0.85)  # of the workspace, metres
CUBE_BODY = "cube_main"
# Our own camera: position and the point it looks at in metres, vertical field of view in degrees. The cube is 9 of 64
# pixels wide there, against 5 in robosuite's "agentview", and the gripper is in the picture from the first frame on.
NEAR = ("near", (0.55, 0.25, 1.15), (0.01, 0.0, 0.925), 32.0)
STEP = 0.015  # metres by which an action of 1 moves the goal: 0.3 m/s
TURN = 0.15  # radians, likewise
REACH = np.array([[-0.35, -0.4, 0.8], [0.3, 0.4, 1.3]])  # bounds of the goal position, metres


def _load_robosuite() -> Any:
    """Imports robosuite without its advice about private macro files."""
    choose_gl()
    logging.disable(logging.WARNING)
    try:
        import robosuite
    finally:
        logging.disable(logging.NOTSET)
    return robosuite


def _yaw(rotation: Float[np.ndarray, "3 3"]) -> float:
    return float(np.arctan2(rotation[1, 0], rotation[0, 0]))


class LiftSim(MujocoSim):
    """The Lift environment: 20 Hz, 7-D actions in [-1, 1] (6-D change of the goal pose, gripper; +1 closes).

    robosuite's OSC_POSE controller pulls the gripper to a goal pose. Its own actions set the goal relative to the
    current pose. The arm always lags behind its goal, so the sum of those actions does not tell where the arm is. Here
    the actions move the goal itself, so that their sum does (notebooks/miniature.md).

    An episode depends only on the arguments of :meth:`reset`. Use as a context manager, or call :meth:`close`: a
    renderer that is freed only when the interpreter exits prints errors.

    Args:
        camera: "near" (our own camera), or the name of one of robosuite's cameras.
        image_size: S, pixels along each side.

    Raises:
        GLError: no OpenGL context can be made.
        ConfigError: there is no such camera.
    """

    def __init__(self, camera: str = "agentview", image_size: int = 64) -> None:
        robosuite = _load_robosuite()
        # robosuite draws the cube's size when it builds the scene. Without a fixed seed, episodes would depend on the
        # process.
        with global_seed(0):
            self._env = robosuite.make(
                "Lift",
                robots="Panda",
                controller_configs=robosuite.load_controller_config(default_controller="OSC_POSE")
                | {"control_delta": False},
                has_renderer=False,
                has_offscreen_renderer=False,
                use_camera_obs=False,
                use_object_obs=False,
                control_freq=20,
                ignore_done=True,
                hard_reset=False,
            )
        self._model = self._env.sim.model._model
        self._data = self._env.sim.data._data
        _compute_once(self._env.sim)
        self._camera_id = choose_camera(self._model, camera, NEAR)
        self._cube_id = self._model.body(CUBE_BODY).id
        self._scenery = Scenery(self._model, self._camera_id, [self._cube_id], CENTRE)
        self._renderer = Renderer(self._model, self._camera_id, image_size)

    def draw_expert(self, rng: np.random.Generator) -> Expert:
        """Draws an episode's manner, and returns the expert with it."""
        return Expert(draw_manner(rng), rng)

    def reset(self, seed: int, variation: Variation = SEEN) -> None:
        """Begins an episode; the seed (0 … 2³² - 1) determines the initial poses of the arm and the cube."""
        self._scenery.apply(variation)
        with global_seed(seed):
            self._env.reset()
        self._goal, self._goal_rotation = self._gripper()

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
        if not np.isfinite(self._data.qpos).all():
            raise ArithmeticError("the simulation diverged: a joint position is not finite")

    @property
    def state(self) -> State:
        gripper, rotation = self._gripper()
        return State(
            gripper=gripper,
            goal=self._goal.copy(),
            gripper_yaw=_yaw(rotation),
            cube=self._data.xpos[self._cube_id].copy(),
            cube_yaw=_yaw(self._data.xmat[self._cube_id].reshape(3, 3)),
        )

    def _gripper(self) -> tuple[Float[np.ndarray, " 3"], Float[np.ndarray, "3 3"]]:
        site = self._env.robots[0].eef_site_id
        return self._data.site_xpos[site].copy(), self._data.site_xmat[site].reshape(3, 3).copy()

    @property
    def success(self) -> bool:
        """Returns robosuite's own success criterion: the cube is more than 4 cm above the table."""
        return bool(self._env._check_success())

    @property
    def places(self) -> dict[str, Float[np.ndarray, " 3"]]:
        """Returns where the object and the gripper are, in metres in the world."""
        state = self.state
        return {"cube": state.cube, "gripper": state.gripper}

    @property
    def object_height(self) -> float:
        """Returns the height of the cube's centre above the table in metres."""
        return float(self._data.xpos[self._cube_id][2]) - TABLE_HEIGHT

    @property
    def opening(self) -> float:
        """Returns the distance between the gripper's fingers in metres, 0 if it is shut."""
        left, right = self._data.qpos[self._env.robots[0]._ref_gripper_joint_pos_indexes]
        return float(left - right)

    @property
    def object_width(self) -> float:
        """Returns the length of the cube's edges in metres."""
        return 2 * float(self._model.geom_size[self._model.body_geomadr[self._cube_id], 0])

    @property
    def object_bodies(self) -> Int32[np.ndarray, " N"]:
        """Returns the body ids of the objects in :meth:`segment` and :meth:`body_poses`."""
        return np.array([self._cube_id], np.int32)


def _compute_once(sim: Any) -> None:
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
