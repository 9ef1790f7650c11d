"""Sends a frame, and what else a page wants to see of it: depth, uncertainty, the simulator's frame, keypoints."""

import asyncio
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rsjax.tools.play import frames
from rsjax.tools.play.frames import Place
from rsjax.tools.play.points import points_of
from rsjax.tools.play.session import Session
from rsjax.tools.play.tree import Node

KINDS = ("depth", "uncertainty", "truth", "truth_depth", "points")
BACKLOG = 8  # frames whose depth may wait; beyond that, new frames get no depth, but a page may ask for it later


@dataclass
class Side:
    """The thread for work that an action's frame does not wait for."""

    pool: ThreadPoolExecutor = field(default_factory=lambda: ThreadPoolExecutor(1, "play-side"))
    waiting: int = 0

    async def run(self, work: Any, *inputs: Any) -> Any:
        """Runs a function in the thread."""
        self.waiting += 1
        try:
            return await asyncio.get_running_loop().run_in_executor(self.pool, work, *inputs)
        finally:
            self.waiting -= 1


def send_rgb(session: Session, place: Place, node: Node) -> None:
    """Sends a frame's picture."""
    session.send(frames.picture("rgb", place, node.moment.rgb))


def send_uncertainty(session: Session, place: Place, node: Node) -> None:
    """Sends the entropy of a frame's tokens; a first frame has none."""
    if node.moment.entropy is not None:
        session.send(frames.uncertainty(place, node.moment.entropy, session.run.bits), droppable=True)


async def send_depth(session: Session, side: Side, place: Place, node: Node) -> None:
    """Decodes and sends a frame's depth."""
    message = await side.run(_depth_message, session, place, node)
    if message is not None:
        session.send(message, droppable=True)


def _depth_message(session: Session, place: Place, node: Node) -> bytes | None:
    depth = session.engine.branching(session.has_depth).depth(node.moment)
    near_far = session.run.trained.assets.normalization.depth_range
    if depth is None or near_far is None:
        return None
    return frames.depth_picture("depth", place, depth, *near_far)


def send_truth(session: Session, place: Place, node: Node, kinds: list[str], mean: float | None) -> None:
    """Sends the simulator's frame, if there is one, and the PSNR of the model's frame."""
    truth = node.truth
    if truth is None:
        return
    if "truth" in kinds:
        session.send(frames.picture("truth", place, truth.rgb), droppable=True)
    near_far = session.run.trained.assets.normalization.depth_range
    if "truth_depth" in kinds and near_far is not None:
        session.send(frames.depth_picture("truth_depth", place, truth.depth, *near_far), droppable=True)
    facts = {"psnr": truth.psnr, "psnr_mean": mean, "success": truth.success}
    session.send({"type": "truth", "id": place.id, "branch": place.branch, "frame": place.frame} | facts)


async def send_points(session: Session, side: Side, place: Place, nodes: list[Node], pane: str) -> None:
    """Finds and sends the keypoints of the last of these frames of a branch."""
    points = await side.run(points_of, session, nodes, pane)
    rounded = [[round(float(x), 4), round(float(y), 4), int(seen)] for x, y, seen in points]
    facts = {"branch": place.branch, "frame": place.frame, "pane": pane, "points": rounded}
    session.send({"type": "points", "id": place.id} | facts, droppable=True)


def mean_psnr(nodes: list[Node]) -> float | None:
    """Returns the mean PSNR over the frames after the first that have one; None if none has."""
    known = [node.truth.psnr for node in nodes[1:] if node.truth is not None and node.truth.psnr is not None]
    if known:
        return float(np.mean(known))
    return None
