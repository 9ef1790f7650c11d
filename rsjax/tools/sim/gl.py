"""The OpenGL library that MuJoCo renders with. Call :func:`choose_gl` before anything imports mujoco or robosuite."""

import ctypes
import ctypes.util
import os

from rsjax.errors import UserError
from rsjax.processes import count_cores

LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}  # in order of preference

# The packages that a bare Debian 12 or 13 lacks: libEGL alone finds no driver, and PyOpenGL's OSMesa also needs libGL.
CURE = "install one with `make setup` or `apt-get install libegl1 libgl1 libgl1-mesa-dri libosmesa6`"


class GLError(UserError):
    """There is no usable OpenGL library. The message says how to get one."""


def _loads(library: str) -> bool:
    """Returns whether this machine has the shared library and can load it."""
    name = ctypes.util.find_library(library)
    if name is None:
        return False
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True


def choose_gl() -> str:
    """Sets ``MUJOCO_GL`` to an OpenGL library that this machine has, unless the user set it, and returns its value.

    Raises:
        GLError: the machine has none, or lacks the one that the user chose.
    """
    wanted = os.environ.get("MUJOCO_GL", "").lower()
    if wanted in LIBRARIES and not _loads(LIBRARIES[wanted]):
        raise GLError(f"MUJOCO_GL is {wanted!r} but lib{LIBRARIES[wanted]} is not on this machine: {CURE}, or unset it")
    if not wanted:
        usable = [name for name, library in LIBRARIES.items() if _loads(library)]
        if not usable:
            raise GLError(f"no OpenGL library (libEGL or libOSMesa) on this machine: {CURE}")
        wanted = usable[0]
        os.environ["MUJOCO_GL"] = wanted
    return wanted


def share_cores(workers: int) -> None:
    """Limits Mesa's renderer in one of several worker processes to its share of the cores, unless the user set it."""
    os.environ.setdefault("LP_NUM_THREADS", str(max(1, count_cores() // workers)))
