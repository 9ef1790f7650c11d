"""LIBERO HDF5 files: robomimic's layout, one file a task, with two traps.

Pictures are upside down, by half a turn, and ``obs[t]`` was recorded *after* ``actions[t]``: that action led into it.
Tested on files of the documented layout that the tests write.
"""

from pathlib import Path

from rsjax.ingest.formats.robomimic import Convention, DemoSource, open_demos

LIBERO = Convention(
    "libero", ("_rgb",), ("ee_states", "gripper_states", "joint_states"), after=True, turned=True, fps=20.0
)


def open_source(path: Path, filter: str = "", depth: bool = False) -> DemoSource:
    """Opens a LIBERO data set. Arguments and errors as in :func:`rsjax.ingest.formats.robomimic.open_source`."""
    return open_demos(path, LIBERO, filter, depth)
