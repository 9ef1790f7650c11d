"""Reads LIBERO HDF5 files: robomimic's layout, one file per task, with two pitfalls.

Pictures are stored bottom row first, as OpenGL renders them, and ``obs[t]`` was recorded *after* ``actions[t]``: that
action led into it. Files that OpenVLA's script made from them have ``obs[t]`` before ``actions[t]``. The reader is
tested on files of the documented layout that the tests write.
"""

import dataclasses
from pathlib import Path

from rsjax.tools.ingest.formats.robomimic import Convention, DemoSource, open_demos

LIBERO = Convention(
    "libero",
    ("_rgb",),
    ("ee_states", "gripper_states", "joint_states"),
    after=True,
    stored="bottom first",
    buffer=True,
    fps=20.0,
)


def open_source(
    path: Path, filter: str = "", depth: bool = False, half_turn: bool = False, after: bool = True
) -> DemoSource:
    """Opens a LIBERO data set.

    Args:
        path: as in :func:`rsjax.tools.ingest.formats.robomimic.open_source`, which raises the same errors.
        filter: likewise.
        depth: likewise.
        half_turn: rotate pictures by 180°, which mirrors left and right, as OpenVLA and its successors train on them;
            otherwise they are flipped upright, as LIBERO's own videos are.
        after: whether ``obs[t]`` was recorded after ``actions[t]``; False for files of OpenVLA's
            ``regenerate_libero_dataset.py``.
    """
    convention = dataclasses.replace(LIBERO, after=after)
    if half_turn:
        convention = dataclasses.replace(convention, stored="half turn")
    return open_demos(path, convention, filter, depth)
