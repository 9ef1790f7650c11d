"""A session together with what its page sees: frames, depth, uncertainty, the simulator's frames, keypoints."""

import asyncio
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from rsjax.data.codec import Record
from rsjax.tools.play import pictures
from rsjax.tools.play.keep import Files
from rsjax.tools.play.messages import Refused
from rsjax.tools.play.pictures import Place
from rsjax.tools.play.points import points_of
from rsjax.tools.play.session import Session
from rsjax.tools.play.sources import PLANNER, Sources
from rsjax.tools.play.tree import Branch, Node
from rsjax.tools.play.truth import Follower, Truths

KINDS = ("depth", "uncertainty", "truth", "truth_depth", "points")
BACKLOG = 8  # frames whose depth may wait; beyond that, new frames get no depth, but a page may ask for it later
SEARCHING = (
    f"the planner tries {PLANNER.rounds} × {PLANNER.candidates} sequences of {PLANNER.horizon} actions; "
    f"its first two searches also compile …"
)
_TRUTHS = {"truth", "truth_depth"}


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
    session.send(pictures.picture("rgb", place, node.state.rgb))


def send_uncertainty(session: Session, place: Place, node: Node) -> None:
    """Sends the entropy of a frame's tokens; a first frame has none."""
    if node.state.entropy is not None:
        session.send(pictures.uncertainty(place, node.state.entropy, session.run.bits), droppable=True)


async def send_depth(session: Session, side: Side, place: Place, node: Node) -> None:
    """Decodes and sends a frame's depth."""
    near_far = session.run.trained.assets.normalization.depth_range

    def picture() -> bytes | None:
        depth = session.engine.branching(session.has_depth).depth(node.state)
        if depth is None or near_far is None:
            return None
        return pictures.depth_picture("depth", place, depth, *near_far)

    message = await side.run(picture)
    if message is not None:
        session.send(message, droppable=True)


def send_truth(session: Session, place: Place, node: Node, kinds: list[str], mean: float | None) -> None:
    """Sends the simulator's frame, if there is one, and the PSNR of the model's frame."""
    truth = node.truth
    if truth is None:
        return
    if "truth" in kinds:
        session.send(pictures.picture("truth", place, truth.rgb), droppable=True)
    near_far = session.run.trained.assets.normalization.depth_range
    if "truth_depth" in kinds and near_far is not None:
        session.send(pictures.depth_picture("truth_depth", place, truth.depth, *near_far), droppable=True)
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


class Viewer:
    """A session, its sources of actions, and the tasks that send pictures to its page.

    Args:
        side: the thread for work that may be late.
        files: the files that sessions save.
        truths: the simulators of all viewers.
    """

    def __init__(self, session: Session, side: Side, files: Files, truths: Truths) -> None:
        self.session = session
        self.side = side
        self.files = files
        self._truths = truths
        self._follower: Follower | None = None
        self._wanted: tuple[int, int] | None = None  # the branch and frame that the simulator shall reach
        self._chase: object | None = None  # identifies the task that does this; a new start gets a new one
        self.sources = Sources(session.run)
        self._tasks: set[asyncio.Task[None]] = set()

    def describe(self) -> dict[str, Any]:
        """Returns the description of the session for a page."""
        start = self.session.start
        has_truth = not self.no_truth and start is not None and start.clip is not None
        return self.session.describe() | {"has_truth": has_truth}

    @property
    def no_truth(self) -> str:
        """The reason why no simulator can run beside sessions; "" if one can."""
        if self._truths.make:
            return ""
        return "the clips are of no simulator that is here"

    def begun(self) -> None:
        """Forgets what belonged to the previous tree."""
        self.sources.acting.clear()
        self.rest()

    def rest(self) -> None:
        """Gives the simulator back, for other viewers."""
        self._wanted = None
        self._chase = None
        if self._follower is not None:
            self._follower.close()
            self._follower = None

    def close(self) -> None:
        """Frees everything at the end of the session."""
        for task in self._tasks:
            task.cancel()
        self.rest()
        self.session.forget()

    async def sourced(self, branch: Branch, source: dict[str, Any]) -> Float[np.ndarray, " A"]:
        """Returns a source's action that leads to a branch's next frame; the page hears that a planner searches."""
        searching = source.get("kind") == "planner"
        if searching:
            self.session.send({"type": "status", "text": SEARCHING, "busy": True})
        try:
            return await asyncio.to_thread(self.sources.action, self.session, branch, source)
        finally:
            if searching:
                self.session.send({"type": "status", "text": "", "busy": False})

    async def show(self, number: int, frame: int, answered: int) -> None:
        """Sends a new frame, and starts to compute what else the page watches."""
        session = self.session
        nodes = session.grown.branch(number).nodes
        place = Place(number, frame, answered)
        node = nodes[frame]
        send_rgb(session, place, node)
        if "uncertainty" in session.watched:
            send_uncertainty(session, place, node)
        if "depth" in session.watched and session.has_depth and self.side.waiting < BACKLOG:
            self._later(send_depth(session, self.side, place, node))
        if "points" in session.watched and self.side.waiting < BACKLOG:
            self._later(send_points(session, self.side, place, nodes[: frame + 1], "rgb"))
        if _TRUTHS & set(session.watched):
            self._follow(number, frame)

    async def again(self, place: Place, nodes: list[Node], kinds: list[str]) -> None:
        """Sends the wanted kinds of pictures of an older frame, the last of these nodes."""
        session = self.session
        node = nodes[-1]
        if session.out is not None:
            await session.out.room()
        if "rgb" in kinds:
            send_rgb(session, place, node)
        if "uncertainty" in kinds:
            send_uncertainty(session, place, node)
        if "depth" in kinds and session.has_depth:
            await send_depth(session, self.side, place, node)
        if "points" in kinds:
            await send_points(session, self.side, place, nodes, "rgb")
            if node.truth is not None:
                await send_points(session, self.side, place, nodes, "truth")
        if _TRUTHS & set(kinds):
            if node.truth is None and _TRUTHS & set(session.watched):
                self._follow(place.branch, place.frame)
            send_truth(session, place, node, kinds, mean_psnr(nodes))

    def _follow(self, number: int, frame: int) -> None:
        """Sends the simulator to a frame, instead of one that it has not reached; frames on the way are shown too."""
        start = self.session.start
        if start is None or start.clip is None or self.no_truth:
            return
        self._wanted = number, frame
        if self._chase is None:
            self._chase = object()
            self._later(self._catch_up(start.clip, self._chase))

    async def _catch_up(self, clip: Record, chase: object) -> None:
        session = self.session
        try:
            while self._wanted is not None:
                (number, frame) = self._wanted
                self._wanted = None
                nodes = session.grown.branch(number).nodes[: frame + 1]
                if self._follower is None:
                    if session.run.simulator and session.run.simulator.train_tasks:
                        task = str(clip["task"])
                    else:
                        task = ""
                    self._follower = Follower(self._truths, clip["provenance"], task)
                filled = await self._follower.follow(nodes)
                if self._chase is not chase:  # these frames are of an earlier start
                    return
                for each in filled:
                    place = Place(number, each, 0)
                    send_truth(session, place, nodes[each], session.watched, mean_psnr(nodes[: each + 1]))
                    if "points" in session.watched:
                        await send_points(session, self.side, place, nodes[: each + 1], "truth")
        except Refused as error:
            if self._chase is chase:
                session.send({"type": "truth_off", "id": 0, "branch": number, "message": error.message})
        finally:
            if self._chase is chase:
                self._chase = None

    def mean_bits(self, node: Node) -> float | None:
        """Returns the mean entropy of a frame's tokens in bits."""
        if node.state.entropy is None:
            return None
        return round(float(node.state.entropy.mean() / np.log(2)), 4)

    def coverage(self, node: Node) -> float | None:
        """Returns the share of the training clips' frames that are nearer to the others than a frame is to them.

        None for a first frame, for a family without features, and for a run without a bank of training clips.
        """
        bank = self.session.run.coverage
        if bank is None or node.state.features is None or node.action is None:
            return None
        _, percentile = bank.of_frames(bank.distances(node.state.features, node.action))
        return round(float(percentile), 4)

    def _later(self, work: Any) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
