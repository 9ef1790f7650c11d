"""Changes of a scene's appearance that training never sees: a moved camera, or objects in other colours.

They do not affect the physics, so an episode with such a change is the same episode with a different appearance.
"""

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float

from rsjax.config import require

Change = Literal["camera", "color"]
# ranges in degrees: to either side about the vertical, and upwards
YAW = (10.0, 25.0)
PITCH = (-4.0, 8.0)
TURN = (0.25, 0.75)  # range of the change of hue, as a share of the hue circle
DEFAULT_COLOR = (0.5, 0.5, 0.5, 1.0)  # MuJoCo's; a geom of this colour is drawn in its material's
# minima of a changed colour, so that grey objects get a hue too
SATURATION = 0.6
VALUE = 0.5


@dataclass(frozen=True)
class Variation:
    """A change of a scene's appearance; none by default.

    Attributes:
        yaw: angle in degrees by which the camera moves about the vertical through the point that it looks at.
        pitch: angle in degrees by which the camera moves upwards about that point.
        turn: change of the objects' hues, as a share of the hue circle.
    """

    yaw: float = 0.0
    pitch: float = 0.0
    turn: float = 0.0


SEEN = Variation()  # no change: the scene as training sees it


def draw_variation(change: Change, rng: np.random.Generator) -> Variation:
    """Draws a change of the camera's position or of the objects' colours."""
    if change == "color":
        return Variation(turn=float(rng.uniform(*TURN)))
    if rng.random() < 0.5:
        side = 1
    else:
        side = -1
    return Variation(yaw=side * float(rng.uniform(*YAW)), pitch=float(rng.uniform(*PITCH)))


class Scenery:
    """Changes and restores the appearance of a MuJoCo model.

    Args:
        model: a ``mujoco.MjModel``.
        camera_id: number of the camera that renders.
        bodies: the bodies whose colours change.
        centre: a point in the workspace, in metres; the camera turns about the point of its optical axis that is
            nearest to ``centre``.
    """

    def __init__(self, model: Any, camera_id: int, bodies: Sequence[int], centre: Sequence[float]) -> None:
        self._model = model
        self._camera = camera_id
        self._centre = np.array(centre)
        self._position = model.cam_pos[camera_id].copy()
        self._quaternion = model.cam_quat[camera_id].copy()
        self._geoms = np.flatnonzero(np.isin(model.geom_bodyid, bodies))
        self._materials = model.geom_matid.copy()
        self._colors = model.geom_rgba.copy()

    def apply(self, variation: Variation) -> None:
        """Gives the model the appearance of a variation, whatever its appearance was before.

        Compute the kinematics again afterwards.

        Raises:
            ConfigError: the camera has to move but is mounted on the arm.
        """
        model = self._model
        model.cam_pos[self._camera] = self._position
        model.cam_quat[self._camera] = self._quaternion
        model.geom_matid[:] = self._materials
        model.geom_rgba[:] = self._colors
        if variation.yaw or variation.pitch:
            self._move_camera(variation)
        for geom in self._geoms if variation.turn else ():
            color = self._color(geom)
            model.geom_matid[geom] = -1
            hue, saturation, value = colorsys.rgb_to_hsv(*map(float, color[:3]))
            hue = (hue + variation.turn) % 1
            turned = colorsys.hsv_to_rgb(hue, max(saturation, SATURATION), max(value, VALUE))
            model.geom_rgba[geom] = (*turned, color[3])

    def _move_camera(self, variation: Variation) -> None:
        require(
            self._model.cam_bodyid[self._camera] == 0,
            "sim.camera moves with the arm, so there is no unseen place for it; choose one that stands still",
        )
        import mujoco

        axes = np.zeros(9)
        mujoco.mju_quat2Mat(axes, self._quaternion)
        right, _, backward = axes.reshape(3, 3).T
        pivot = self._position - backward * ((self._position - self._centre) @ backward)
        turn = _rotation(np.array([0, 0, 1.0]), variation.yaw) @ _rotation(right, -variation.pitch)
        rotation = turn @ axes.reshape(3, 3)
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, rotation.ravel())
        self._model.cam_pos[self._camera] = pivot + turn @ (self._position - pivot)
        self._model.cam_quat[self._camera] = quaternion

    def _color(self, geom: Any) -> Float[np.ndarray, " 4"]:
        """Returns a geom's colour and opacity, 0 … 1; the mean colour if it has a texture."""
        model = self._model
        material = self._materials[geom]
        own = np.array(self._colors[geom], np.float64)
        if material < 0:
            return own
        if (own == DEFAULT_COLOR).all():
            color = np.array(model.mat_rgba[material], np.float64)
        else:
            color = own
        texture = max(model.mat_texid[material])
        if texture < 0:
            return color
        start = model.tex_adr[texture]
        channels = model.tex_nchannel[texture]
        pixels = model.tex_data[start : start + model.tex_height[texture] * model.tex_width[texture] * channels]
        return np.append(color[:3] * pixels.reshape(-1, channels)[:, :3].mean(0) / 255, color[3])


def aim(model: Any, camera_id: int, position: Sequence[float], target: Sequence[float], fovy: float) -> None:
    """Moves a camera to a position and points it, upright, at a target, both in metres in the camera body's frame."""
    import mujoco

    backward = np.array(position) - np.array(target)
    right = np.cross([0, 0, 1], backward)
    axes = np.stack([right, np.cross(backward, right), backward], -1)
    mujoco.mju_mat2Quat(model.cam_quat[camera_id], (axes / np.linalg.norm(axes, axis=0)).ravel())
    model.cam_pos[camera_id] = position
    model.cam_fovy[camera_id] = fovy


def _rotation(axis: Float[np.ndarray, " 3"], degrees: float) -> Float[np.ndarray, "3 3"]:
    """Returns the rotation about a unit axis (Rodrigues)."""
    angle = np.radians(degrees)
    cross = np.cross(np.eye(3), axis)  # cross @ v is axis × v
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
