"""Shows clips in the Rerun viewer: pictures, depth, tracks and actions by frame. Needs the extra ``rerun``."""

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

from rsjax.data.codec import Record
from rsjax.data.store import Store
from rsjax.errors import UserError, first_line
from rsjax.tools.studies.report.contents import clips_of

TIMELINE = "frame"


def rerun_view(store: Store, clips: int = 4, file: Path | None = None) -> list[str]:
    """Opens some clips in the viewer, or writes them to a file that ``rerun FILE.rrd`` opens.

    Clip n is the entity ``clip_00n``. Below it are ``camera``, ``camera/tracks`` (the visible points, in pixels),
    ``depth`` (if the clip has it; in metres unless its provenance names another unit), ``actions``, and ``task``, which
    is the same for all frames.

    Args:
        store: a store of clips.
        clips: how many clips, spread evenly over the store.
        file: the file to write instead of opening the viewer.

    Returns:
        Messages of the clips that cannot be read.

    Raises:
        UserError: the extra is not installed, the viewer does not answer, or the file cannot be written.
        StoreError: the store contains tokens, or no clip can be read.
    """
    try:
        import rerun
    except ImportError as error:
        raise UserError("--rerun and --rerun-file need the viewer: pip install 'rsjax[rerun]'") from error
    damaged = list[str]()
    shown = 0
    recording = rerun.RecordingStream("rsjax")
    try:
        for _, _, record in clips_of(store, clips, damaged):
            if not shown:
                if file is not None:
                    recording.save(file)
                else:
                    # The viewer may lie next to this Python, whose environment may be inactive.
                    before = os.environ.get("PATH", "")
                    os.environ["PATH"] = os.pathsep.join(filter(None, (before, str(Path(sys.executable).parent))))
                    try:
                        recording.spawn()
                    finally:
                        os.environ["PATH"] = before
            _log_clip(rerun, recording, f"clip_{shown:03d}", record)
            shown += 1
        recording.flush()
        recording.disconnect()
    except (OSError, RuntimeError) as error:  # of Rerun's viewer, or of its file
        reason = first_line(error)
        if file is None:
            cure = "it needs a screen; write a file for one elsewhere with --rerun-file"
            raise UserError(f"the Rerun viewer does not answer ({reason}); {cure}") from error
        raise UserError(f"{file}: cannot be written ({reason}); choose another place") from error
    return damaged


def _log_clip(rerun: Any, recording: Any, name: str, record: Record) -> None:
    recording.log(f"{name}/task", rerun.TextDocument(record["task"]), static=True)
    metres = record["provenance"].get("depth_unit", "metres") == "metres"
    for frame, rgb in enumerate(record["rgb"]):
        recording.set_time(TIMELINE, sequence=frame)
        recording.log(f"{name}/camera", rerun.Image(rgb))
        if record.get("depth") is not None:
            depth = rerun.DepthImage(record["depth"][frame], meter=1.0 if metres else None)
            recording.log(f"{name}/depth", depth)
        visible = np.flatnonzero(record["visible"][:, frame])
        pixels = record["tracks"][visible, frame] * (rgb.shape[1], rgb.shape[0])
        recording.log(f"{name}/camera/tracks", rerun.Points2D(pixels, keypoint_ids=visible.astype(np.uint16)))
        recording.log(f"{name}/actions", rerun.Scalars(record["actions"][frame]))
