"""The simulators' base class: a camera, pictures, and the exact pose of every body of a MuJoCo scene."""

from typing import Any, Self

import numpy as np
from jaxtyping import Bool, Float, Int32

from rsjax.config import require
from rsjax.tools.sim.render import Camera, Renderer, View
from rsjax.tools.sim.scenery import aim

# A camera of our own: its name, position and the point it looks at in metres, vertical field of view in degrees.
OwnCamera = tuple[str, tuple[float, float, float], tuple[float, float, float], float]


class MujocoSim:
    """A MuJoCo scene seen by one camera. A subclass sets the attributes. Use as a context manager, or :meth:`close` it.

    A renderer that is freed only when the interpreter exits prints errors.
    """

    _env: Any  # the simulator's own environment
    _model: Any
    _data: Any
    _camera_id: int
    _renderer: Renderer

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Frees the renderer and the simulation."""
        self._renderer.close()
        self._env.close()

    def check_stable(self) -> None:
        """Raises :class:`ArithmeticError` if the simulation has diverged since the last reset.

        MuJoCo then begins anew by itself, from positions that are finite; only its warnings tell.
        """
        from mujoco import mjtWarning

        kinds = (mjtWarning.mjWARN_BADQPOS, mjtWarning.mjWARN_BADQVEL, mjtWarning.mjWARN_BADQACC)
        if any(self._data.warning[int(kind)].number for kind in kinds):
            raise ArithmeticError("the simulation diverged: MuJoCo met a number that is huge or not finite")

    @property
    def camera(self) -> Camera:
        return Camera(
            self._data.cam_xpos[self._camera_id].copy(),
            self._data.cam_xmat[self._camera_id].reshape(3, 3).copy(),
            float(self._model.cam_fovy[self._camera_id]),
        )

    @property
    def movable(self) -> Bool[np.ndarray, " bodies"]:
        """Returns whether each body can move at all (is not welded to the world)."""
        return np.array(self._model.body_weldid != 0)

    def body_poses(self) -> tuple[Float[np.ndarray, "bodies 3"], Float[np.ndarray, "bodies 3 3"]]:
        """Returns each body's position in metres and rotation in the world."""
        return self._data.xpos.copy(), self._data.xmat.reshape(-1, 3, 3).copy()

    def render(self) -> View:
        """Renders the current frame."""
        return self._renderer.render(self._data)

    def segment(self) -> Int32[np.ndarray, "S S"]:
        """Returns the body id at each pixel's centre; 0 (the world) where there is nothing."""
        return self._renderer.segment(self._data)


def choose_camera(model: Any, name: str, own: OwnCamera) -> int:
    """Returns the id of the named camera; our own camera replaces the scene's first one.

    Raises:
        ConfigError: there is no such camera.
    """
    names = [model.camera(i).name for i in range(model.ncam)]
    if name != own[0]:
        require(name in names, f"sim.camera is {name!r}; this scene has {own[0]}, {', '.join(names)}")
        return names.index(name)
    aim(model, 0, *own[1:])
    return 0
