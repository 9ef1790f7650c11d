"""A fast software renderer of MuJoCo scenes.

robosuite renders RGB and depth at the target size with a shadow map, 4× multisampling and reflections: about 50 ms a
frame on one CPU core. This renderer makes one pass at 3× the target size without any of these, in about 12 ms. RGB is
the mean of 3×3 pixels (anti-aliased); depth is that of the middle pixel, whose ray passes through the target pixel's
centre.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int32, UInt8

from rsjax.tools.sim.gl import CURE, GLError

SUPERSAMPLING = 3  # odd, so that a target pixel's centre is a rendered pixel's centre


@dataclass(frozen=True)
class Camera:
    """A pinhole camera with square pixels and a square image.

    Attributes:
        position: position in the world in metres.
        rotation: columns are the camera's right, up and backward axes in the world (MuJoCo's convention).
        fovy: vertical field of view in degrees.
    """

    position: Float[np.ndarray, " 3"]
    rotation: Float[np.ndarray, "3 3"]
    fovy: float

    @property
    def extent(self) -> float:
        """Returns the metres that the image spans at a depth of 1 m."""
        return 2 * self._half

    @property
    def _half(self) -> float:
        return float(np.tan(np.radians(self.fovy) / 2))

    def project(self, points: Float[np.ndarray, "*N 3"]) -> tuple[Float[np.ndarray, "*N 2"], Float[np.ndarray, "*N"]]:
        """Projects world points to (x, y), 0 and 1 at the image's edges, y down, and depth in metres (< 0: behind)."""
        local = (points - self.position) @ self.rotation
        depth = -local[..., 2]
        x = 0.5 + 0.5 * local[..., 0] / (depth * self._half)
        y = 0.5 - 0.5 * local[..., 1] / (depth * self._half)
        return np.stack([x, y], -1), depth

    def unproject(self, xy: Float[np.ndarray, "*N 2"], depth: Float[np.ndarray, "*N"]) -> Float[np.ndarray, "*N 3"]:
        """Inverts :meth:`project`."""
        right = (2 * xy[..., 0] - 1) * self._half * depth
        up = (1 - 2 * xy[..., 1]) * self._half * depth
        return np.stack([right, up, -depth], -1) @ self.rotation.T + self.position


@dataclass(frozen=True)
class View:
    """One rendered frame.

    Attributes:
        rgb: upright, 0–255.
        depth: z-depth in metres at the pixels' centres.
        fine_depth: the same at ``SUPERSAMPLING`` times the resolution, for visibility tests.
    """

    rgb: UInt8[np.ndarray, "S S 3"]
    depth: Float32[np.ndarray, "S S"]
    fine_depth: Float32[np.ndarray, "R R"]


class Renderer:
    """Renders a MuJoCo model from one fixed camera. Close it explicitly.

    Args:
        model: a ``mujoco.MjModel``; the renderer changes its rendering quality and buffer size.
        camera_id: number of the camera in the model.
        size: S, pixels along each side.
        hidden: groups of geoms that are left out, such as collision shapes (group 0 in robosuite).

    Raises:
        GLError: no OpenGL context can be made.
    """

    def __init__(self, model: Any, camera_id: int, size: int, hidden: tuple[int, ...] = (0,)) -> None:
        import mujoco

        self._mj = mujoco
        self._model = model
        self._size = size
        self._fine = size * SUPERSAMPLING
        model.vis.quality.shadowsize = 0
        model.vis.quality.offsamples = 0
        model.vis.global_.offwidth = self._fine
        model.vis.global_.offheight = self._fine
        try:
            self._gl = mujoco.GLContext(self._fine, self._fine)
        except Exception as error:  # each OpenGL binding fails in its own way
            raise GLError(f"no OpenGL context can be made ({error}): {CURE}, or set MUJOCO_GL=osmesa") from error
        self._gl.make_current()
        self._context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        self._scene = mujoco.MjvScene(model, 1000)
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            self._scene.flags[flag] = 0
        self._options = mujoco.MjvOption()
        self._options.geomgroup[list(hidden)] = 0
        self._options.sitegroup[:] = 0
        self._camera = mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._camera.fixedcamid = camera_id
        self._rect = mujoco.MjrRect(0, 0, self._fine, self._fine)

    def close(self) -> None:
        """Frees the OpenGL context."""
        self._gl.make_current()  # else another renderer's objects, which have the same numbers, would be deleted
        self._context.free()
        self._gl.free()

    def _draw(self, data: Any) -> tuple[UInt8[np.ndarray, "R R 3"], Float32[np.ndarray, "R R"]]:
        mujoco = self._mj
        self._gl.make_current()
        everything = mujoco.mjtCatBit.mjCAT_ALL
        mujoco.mjv_updateScene(
            self._model, data, self._options, mujoco.MjvPerturb(), self._camera, everything, self._scene
        )
        mujoco.mjr_render(self._rect, self._scene, self._context)
        rgb = np.empty((self._fine, self._fine, 3), np.uint8)
        depth = np.empty((self._fine, self._fine), np.float32)
        mujoco.mjr_readPixels(rgb, depth, self._rect, self._context)
        return rgb[::-1], depth[::-1]  # OpenGL's first row is the bottom one

    def render(self, data: Any) -> View:
        """Renders the frame that ``data`` (a ``mujoco.MjData``) describes."""
        rgb, buffer = self._draw(data)
        near, far = (getattr(self._model.vis.map, name) * self._model.stat.extent for name in ("znear", "zfar"))
        fine = (near / (1 - buffer.astype(np.float64) * (1 - near / far))).astype(np.float32)
        blocks = rgb.reshape(self._size, SUPERSAMPLING, self._size, SUPERSAMPLING, 3)
        return View(
            rgb=np.round(blocks.mean((1, 3), dtype=np.float32)).astype(np.uint8),
            depth=np.ascontiguousarray(_centres(fine)),
            fine_depth=fine,
        )

    def segment(self, data: Any) -> Int32[np.ndarray, "S S"]:
        """Returns the body id at each pixel's centre; 0 (the world) where there is nothing."""
        mujoco = self._mj
        flags = self._scene.flags
        flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = 1
        flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = 1
        try:
            rgb, _ = self._draw(data)
        finally:
            flags[mujoco.mjtRndFlag.mjRND_SEGMENT] = 0
            flags[mujoco.mjtRndFlag.mjRND_IDCOLOR] = 0
        ids = _centres(rgb).astype(np.int32) @ np.array([1, 256, 65536], np.int32)
        body_of = np.zeros(self._scene.ngeom + 1, np.int32)  # index 0: no geom
        for geom in self._scene.geoms[: self._scene.ngeom]:
            if geom.segid >= 0 and geom.objtype == mujoco.mjtObj.mjOBJ_GEOM:
                body_of[geom.segid + 1] = self._model.geom_bodyid[geom.objid]
        return body_of[np.where(ids <= self._scene.ngeom, ids, 0)]


def _centres(fine: np.ndarray) -> np.ndarray:
    """Returns the middle pixel of each ``SUPERSAMPLING``² block."""
    return fine[SUPERSAMPLING // 2 :: SUPERSAMPLING, SUPERSAMPLING // 2 :: SUPERSAMPLING]
