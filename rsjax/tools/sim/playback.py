"""Renders recorded simulator states: a demo's MuJoCo model and one state of each frame.

A model that comes from elsewhere may name any file. Only files of the installed robosuite are loaded, whatever path the
model gives for them.
"""

import importlib.util
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float

from rsjax.errors import UserError, first_line
from rsjax.tools.sim.gl import choose_gl
from rsjax.tools.sim.render import Renderer, View

CAMERAS = ("agentview", "robot0_eye_in_hand")  # rendered of robosuite's own models; of other models, all cameras are
_MOST_TEXT = 2**23  # characters of a model
_MOST_PIXELS = 2**24  # of a texture or height field that the model describes instead of naming a file
_REFUSED = ("include", "plugin", "extension", "model", "attach")  # elements that load other models or libraries
_FOLDERS = ("meshdir", "texturedir", "assetdir", "strippath")  # attributes of the compiler


class PlaybackError(UserError):
    """A model cannot be rendered. The message gives the reason, but neither the file nor the cure."""


def camera_names(model: str) -> tuple[str, ...]:
    """Returns the names of a model's cameras that are worth rendering, the preferred one first.

    Args:
        model: MJCF, as :func:`local_model` returns it.
    """
    names = [str(camera.get("name")) for camera in ElementTree.fromstring(model).iter("camera") if camera.get("name")]
    return tuple(name for name in CAMERAS if name in names) or tuple(names)


def local_model(text: str) -> str:
    """Returns a model whose meshes and textures are those of the installed robosuite.

    Args:
        text: MJCF, as robosuite's recordings have it.

    Raises:
        PlaybackError: ``text`` is not MJCF, robosuite is not installed or lacks one of the files, or the model would
            load something else.
    """
    if len(text) > _MOST_TEXT or "<!" in text.replace("<!--", ""):
        raise PlaybackError("the model is too long, or declares entities")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise PlaybackError(f"the model is not XML ({error})") from error
    package = importlib.util.find_spec("robosuite")
    if root.tag != "mujoco" or package is None or package.origin is None:
        raise PlaybackError("robosuite is not installed" if root.tag == "mujoco" else "the model is not MJCF")
    assets = (Path(package.origin).parent / "models" / "assets").resolve()
    for element in root.iter():
        if element.tag in _REFUSED:
            raise PlaybackError(f"the model has an element {element.tag!r}, which loads other files")
        if element.tag in ("texture", "hfield"):
            for pair in (("width", "height"), ("ncol", "nrow")):
                try:
                    first, second = (int(element.get(name, "1")) for name in pair)
                except ValueError as error:
                    raise PlaybackError(f"the model has a {element.tag} of a size that is not a number") from error
                if not 0 < first * second <= _MOST_PIXELS:
                    raise PlaybackError(f"the model has a {element.tag} of {first} × {second}")
        for name in _FOLDERS if element.tag == "compiler" else ():
            element.attrib.pop(name, None)
        if element.tag == "size":
            element.attrib.pop("memory", None)
        for name, value in element.attrib.items():
            if name.startswith("file"):
                _, separator, inner = value.replace("\\", "/").rpartition("/models/assets/")
                path = (assets / inner).resolve()
                if not separator or not path.is_relative_to(assets) or not path.is_file():
                    raise PlaybackError(
                        f"the model names the file {value!r:.200}, which the installed robosuite does not have"
                    )
                element.set(name, str(path))
    return ElementTree.tostring(root, encoding="unicode")


class Playback:
    """Renders a model from one camera, in any state. Close it explicitly.

    Args:
        model: MJCF, as :func:`local_model` returns it.
        camera: name of one of its cameras.
        size: pixels along each side.

    Raises:
        PlaybackError: MuJoCo refuses the model, or it has no such camera.
        GLError: no OpenGL context can be made.
    """

    def __init__(self, model: str, camera: str, size: int) -> None:
        choose_gl()
        import mujoco

        self._mj: Any = mujoco
        try:
            self._model = mujoco.MjModel.from_xml_string(model)
            self._data = mujoco.MjData(self._model)
            camera_id = self._model.camera(camera).id
        except (ValueError, KeyError, MemoryError, mujoco.FatalError) as error:
            raise PlaybackError(f"MuJoCo refuses the model ({first_line(error)})") from error
        self._renderer = Renderer(self._model, camera_id, size)

    def close(self) -> None:
        """Frees the renderer."""
        self._renderer.close()

    def render(self, state: Float[np.ndarray, " n"]) -> View:
        """Renders a state: time, joint positions (nq) and joint velocities (nv).

        Raises:
            PlaybackError: the state has the wrong length for the model, or a number in it is not finite.
        """
        positions = self._model.nq
        wanted = 1 + self._model.nq + self._model.nv
        if len(state) != wanted or not np.isfinite(state).all():
            raise PlaybackError(f"a state has {len(state)} numbers, the model takes {wanted} finite ones")
        self._data.qpos[:] = state[1 : 1 + positions]
        for place in (self._mj.mj_kinematics, self._mj.mj_comPos, self._mj.mj_camlight, self._mj.mj_tendon):
            place(self._model, self._data)
        return self._renderer.render(self._data)
