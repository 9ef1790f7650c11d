"""robosuite's Lift with the Panda arm."""

import numpy as np
from jaxtyping import Float

from rsjax.tools.sim.expert import TABLE_HEIGHT, Expert, LiftState, draw_manner
from rsjax.tools.sim.panda import PandaSim, yaw_of

TASK = "lift the red cube"
ANY_TASK = "lift the cube"  # the task where the cube has another colour
CUBE_BODY = "cube_main"
# Our own camera: position and the point it looks at in metres, vertical field of view in degrees. The cube is 9 of 64
# pixels wide there, against 5 in robosuite's "agentview", and the gripper is in the picture from the first frame on.
NEAR = ("near", (0.55, 0.25, 1.15), (0.01, 0.0, 0.925), 32.0)


class LiftSim(PandaSim):
    """The Lift environment, with the actions of :class:`PandaSim`.

    Args:
        camera: "near" (our own camera), or the name of one of robosuite's cameras.
        image_size: S, pixels along each side.

    Raises:
        GLError: no OpenGL context can be made.
        ConfigError: there is no such camera.
    """

    def __init__(self, camera: str = "agentview", image_size: int = 64) -> None:
        super().__init__(
            lambda robosuite, settings: robosuite.make("Lift", use_object_obs=False, **settings),
            [CUBE_BODY],
            camera,
            NEAR,
            image_size,
        )
        self._cube_id = self.object_bodies[0]

    def draw_expert(self, rng: np.random.Generator) -> Expert:
        """Draws an episode's manner, and returns the expert with it."""
        return Expert(draw_manner(rng), rng)

    @property
    def state(self) -> LiftState:
        gripper, rotation = self.gripper
        return LiftState(
            gripper=gripper,
            goal=self._goal.copy(),
            gripper_yaw=yaw_of(rotation),
            cube=self._data.xpos[self._cube_id].copy(),
            cube_yaw=yaw_of(self._data.xmat[self._cube_id].reshape(3, 3)),
        )

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
    def object_width(self) -> float:
        """Returns the length of the cube's edges in metres."""
        return 2 * float(self._model.geom_size[self._model.body_geomadr[self._cube_id], 0])
