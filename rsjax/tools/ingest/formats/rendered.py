"""Pictures and depth maps rendered from the simulator states of a robosuite demo, when they are read."""

import atexit
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from rsjax.tools.ingest.episode import Depths, EpisodeError, Frames, data_file, reason
from rsjax.tools.ingest.formats.files import inside
from rsjax.tools.ingest.formats.hdf5 import attribute, rows
from rsjax.tools.sim.gl import choose_gl
from rsjax.tools.sim.playback import Playback, PlaybackError, camera_names, local_model

FAR = 10.0  # metres; a depth map has 0 beyond it, like that of a depth camera
CURE = "render the file with robomimic's dataset_states_to_obs.py --camera_names …"
_MOST_VIEWS = 1024  # views kept for the steps of an ingest that read the same episode

Pictures = tuple[dict[str, Frames], dict[str, Depths]]  # each by the camera's name
View = tuple[UInt8[np.ndarray, "S S 3"], Float32[np.ndarray, "S S"]]


def rendered(group: Any, path: Path, size: int) -> Pictures:
    """Returns the pictures and depth maps of a demo that has ``states`` and a ``model_file``.

    Args:
        group: the demo's group in an HDF5 file.
        path: the file.
        size: pixels along each side of a picture.

    Raises:
        EpisodeError: the demo lacks one of them, or its model would load what the installed robosuite does not have.
        GLError: there is no OpenGL library.
    """
    where = f"{path}: {group.name.lstrip('/')}"
    model = attribute(group, "model_file")
    if not isinstance(model, str) or "states" not in group:
        raise EpisodeError.at(where, "has neither pictures in obs nor states and model_file to render", CURE)
    try:
        if model.endswith(".xml"):  # older demos keep the model in a folder beside the file
            model = data_file(inside(path.parent / "models", model)).read_text("utf-8")
        model = local_model(model)
    except PlaybackError as error:
        raise EpisodeError.at(where, f"{error}, so it cannot be rendered here", CURE) from error
    except (OSError, ValueError) as error:
        raise EpisodeError.at(f"{where}: model_file", reason(error)) from error
    choose_gl()
    states = rows(group, "states", path)
    cameras = {name: RenderedStates(model, states, name, size, where) for name in camera_names(model)}
    return {**cameras}, {name: replace(frames, depth=True) for name, frames in cameras.items()}


@dataclass(frozen=True, eq=False)
class RenderedStates:
    """The pictures of one camera, as :class:`rsjax.tools.ingest.episode.Frames`, or its depth maps, as ``Depths``.

    Attributes:
        model: MJCF, as :func:`rsjax.tools.sim.playback.local_model` returns it.
        states: as :meth:`rsjax.tools.sim.playback.Playback.render` takes them, a row for each frame.
        camera: the camera's name in the model.
        size: S, pixels along each side.
        where: the file and demo that error messages name.
        depth: whether to return depth maps, in metres.
    """

    model: str
    states: Float32[np.ndarray, "N n"]
    camera: str
    size: int
    where: str
    depth: bool = False

    def __len__(self) -> int:
        return len(self.states)

    def read(self, indices: Sequence[int]) -> np.ndarray:
        """Returns these pictures or maps; :class:`EpisodeError` if the model or a state cannot be rendered."""
        try:
            views = [_scene(self).view(self.states[int(index)]) for index in indices]
        except PlaybackError as error:
            raise EpisodeError.at(self.where, str(error), CURE) from error
        return np.stack([view[self.depth] for view in views])


class _Scene:
    """The open renderer of one model and camera, and its last views."""

    def __init__(self, key: tuple[object, ...], frames: RenderedStates) -> None:
        self.key = key
        self.process = os.getpid()
        self._playback = Playback(frames.model, frames.camera, frames.size)
        self._views: dict[bytes, View] = {}

    def view(self, state: Float32[np.ndarray, " n"]) -> View:
        key = state.tobytes()
        if key not in self._views:
            view = self._playback.render(state)
            if len(self._views) == _MOST_VIEWS:
                self._views.pop(next(iter(self._views)))
            self._views[key] = view.rgb, np.where(view.depth > FAR, np.float32(0), view.depth)
        return self._views[key]

    def close(self) -> None:
        self._playback.close()


_scenes: list[_Scene] = []  # at most one is this process's; scenes from before a fork stay untouched


def _scene(frames: RenderedStates) -> _Scene:
    """Returns the open scene of these pictures; opens it and closes any other scene if needed."""
    key = (frames.model, frames.camera, frames.size)
    own = [scene for scene in _scenes if scene.process == os.getpid()]
    if own and own[0].key == key:
        return own[0]
    _close()
    _scenes.append(_Scene(key, frames))
    atexit.unregister(_close)
    atexit.register(_close)  # only now, since what mujoco registered on its import must run later
    return _scenes[-1]


def _close() -> None:
    """Frees the renderer: one that is freed only when the interpreter exits prints errors."""
    for scene in [scene for scene in _scenes if scene.process == os.getpid()]:
        _scenes.remove(scene)
        scene.close()
