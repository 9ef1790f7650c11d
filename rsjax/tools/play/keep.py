"""Saves what was played: branches as videos, or as clips of a store.

Axes: T frames, S×S pixels.
"""

import secrets
import shutil
import time
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from rsjax.clip import GENERATED, GENERATED_MARK
from rsjax.data.build import write_clips
from rsjax.errors import UserError, first_line, storage_limit
from rsjax.tools.play.messages import Refused
from rsjax.tools.play.session import Session
from rsjax.tools.play.tree import Branch, Node
from rsjax.tools.policies.demos import controls_of
from rsjax.tools.studies.report.depth_view import depth_to_colors
from rsjax.tools.studies.report.video import write_gif, write_mp4

MOST_BYTES = 2**29  # of a video's pictures before encoding
MOST_GIF = 600  # frames
MOST_FILES = 256  # files that can be fetched
GAP = 2  # pixels between panes
TYPES = {".mp4": "video/mp4", ".gif": "image/gif", ".zip": "application/zip"}


class Files:
    """The files that sessions made, which a page fetches by a number that nobody can guess.

    Args:
        folder: the folder of the files.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._paths: OrderedDict[str, Path] = OrderedDict()

    def __getitem__(self, number: str) -> Path | None:
        return self._paths.get(number)

    def place(self, session: Session, what: str) -> Path:
        """Returns a path for a new file; only the server chooses its name."""
        start = session.start
        if start is None or start.number is None:
            begun = "picture"
        else:
            begun = f"clip{start.number}"
        return self.folder / f"{time.strftime('%Y%m%d-%H%M%S')}-{begun}-{secrets.token_hex(3)}{what}"

    def add(self, path: Path) -> dict[str, Any]:
        """Adds a file and returns its description for a page."""
        number = secrets.token_urlsafe(16)
        self._paths[number] = path
        while len(self._paths) > MOST_FILES:
            self._paths.popitem(last=False)
        facts = {"name": path.name, "url": f"/api/file/{number}", "bytes": path.stat().st_size}
        return {"type": "file"} | facts | {"path": str(path)}


def record(session: Session, path: Path, number: int, panes: list[str], fps: float, scale: int) -> None:
    """Writes a branch as a video, .mp4 or .gif, with panes side by side.

    Args:
        panes: "rgb", "depth", "truth", or "branch:N", another branch's frames.

    Raises:
        Refused: there is no such pane, the video is too large, or it cannot be written to the disk.
    """
    nodes = session.grown.branch(number).nodes
    side = session.run.data.config.clips.image_size
    if path.suffix == ".gif":
        most = MOST_GIF
    else:
        most = MOST_BYTES
    if len(nodes) > most or len(nodes) * len(panes) * 3 * (scale * side) ** 2 > MOST_BYTES:
        raise Refused("too_large", "the video would be too large; take a smaller scale, fewer panes, or MP4")
    columns = [pane_frames(session, nodes, pane) for pane in panes]
    gap = np.zeros((len(nodes), side, GAP, 3), np.uint8)
    parts = [part for column in columns for part in (gap, column)][1:]
    with _writing():
        write = write_gif if path.suffix == ".gif" else write_mp4
        write(path, np.concatenate(parts, axis=2), fps, scale, GENERATED_MARK)


def pane_frames(session: Session, nodes: list[Node], pane: str) -> UInt8[np.ndarray, "T S S 3"]:
    """Returns a pane's pictures for these frames; a shorter branch holds its last frame, a missing truth is grey."""
    own = [node.state.rgb for node in nodes]
    if pane == "rgb":
        return np.stack(own)
    if pane == "truth":
        return np.stack([np.full_like(own[0], 128) if node.truth is None else node.truth.rgb for node in nodes])
    if pane == "depth":
        near_far = session.run.trained.assets.normalization.depth_range
        if not session.has_depth or near_far is None:
            raise Refused("bad_message", "this session has no depth")
        return depth_to_colors(np.stack([_depth(session, node) for node in nodes]), *near_far)
    kind, _, number = pane.partition(":")
    if kind != "branch" or not number.isdecimal() or len(number) > 5:
        raise Refused("bad_message", f"panes has {pane!r:.40}; there are rgb, depth, truth and branch:NUMBER")
    others = [node.state.rgb for node in session.grown.branch(int(number)).nodes]
    return np.stack([others[min(frame, len(others) - 1)] for frame in range(len(nodes))])


def export(session: Session, path: Path, numbers: list[int]) -> Path:
    """Writes branches as clips of a store, and returns the path of a zip file of the store, which is beside it.

    A clip has as many frames as the run's clips; remaining frames at a branch's end are left out.

    Raises:
        Refused: no branch is long enough, or the store cannot be written to the disk.
    """
    branches = [session.grown.branch(number) for number in numbers]
    length = session.run.data.config.clips.frames
    if not any(True for branch in branches for _ in _windows(branch, length)):
        raise Refused("no_frame", f"a clip has {length} frames; no branch has as many of its own yet")
    with _writing():
        path.parent.mkdir(parents=True, exist_ok=True)
        records = (_clip(session, branch, first, length) for branch in branches for first in _windows(branch, length))
        write_clips(path, records, test_share=0.0)
        return Path(shutil.make_archive(str(path), "zip", path))


def _windows(branch: Branch, length: int) -> Iterator[int]:
    """Yields the first frame of each clip of a branch, except clips that are entirely shared with the parent."""
    for first in range(0, len(branch.nodes) - length + 1, length):
        if branch.fork is None or first + length - 1 > branch.fork:
            yield first


def _clip(session: Session, branch: Branch, first: int, length: int) -> dict[str, Any]:
    nodes = branch.nodes[first : first + length]
    start = session.start
    run = session.run
    width = run.controls.width
    actions = [np.zeros(width, np.float32), *(node.action for node in nodes[1:])]
    origin: dict[str, Any] = {} if start is None or start.clip is None else start.clip["provenance"]
    if start is None:
        clip = None
    else:
        clip = start.number
    if run.store is None:
        manifest = {}
    else:
        manifest = run.store.manifest
    if start is None or start.clip is None:
        steps = 1
    else:
        steps = controls_of(start.clip, manifest)
    made: dict[str, Any] = {
        "rgb": np.stack([node.state.rgb for node in nodes]),
        "actions": np.stack(actions),  # type: ignore[arg-type]
        "task": "unknown" if start is None or start.clip is None else start.clip["task"],
        "episode": f"{session.name}-{branch.number}-{first}",
        "fps": run.fps,
    }
    metric = (manifest.get("depth_unit") or "metres") == "metres"  # stores of generated clips have no other unit
    if session.has_depth and metric:
        made["depth"] = np.maximum(np.stack([_depth(session, node) for node in nodes]), 1e-3)
    made["provenance"] = {
        "source": GENERATED,
        "family": run.data.config.model.family,
        "model": run.fingerprint,
        "from": {"key": str(manifest.get("key")), "split": run.split, "clip": clip, "episode": origin.get("episode")},
        "seed": session.seed,
        "draw": branch.draw,
        "first_frame": first,
        "camera": str(origin.get("camera") or "image"),
        "control_steps": steps,
    }
    return made


def _depth(session: Session, node: Node) -> np.ndarray:
    depth = session.engine.branching(True).depth(node.state)
    assert depth is not None
    return depth


@contextmanager
def _writing() -> Iterator[None]:
    """Turns errors of the disk into :class:`Refused`."""
    try:
        yield
    except UserError as error:
        raise Refused("disk", first_line(error)) from error
    except OSError as error:
        raise Refused("disk", storage_limit(error) or f"nothing can be written: {error.strerror or error}") from error
