"""A session with what its page sees of it."""

import asyncio
from typing import Any

import numpy as np
from jaxtyping import Float

from rsjax.play import shown
from rsjax.play.frames import Place
from rsjax.play.keep import Files
from rsjax.play.session import Session
from rsjax.play.shown import BACKLOG, Side
from rsjax.play.sources import Sources
from rsjax.play.tree import Branch, Node


class Viewer:
    """A session, its ways to act, and the pictures that are on their way to its page.

    Args:
        side: the thread of what may be late.
        files: where what is kept goes.
    """

    def __init__(self, session: Session, side: Side, files: Files) -> None:
        self.session, self.side, self.files = session, side, files
        self.sources = Sources(session.run)
        self._tasks: set[asyncio.Task[None]] = set()

    def describe(self) -> dict[str, Any]:
        """Returns the session for a page."""
        return self.session.describe() | {"has_truth": not self.no_truth}

    @property
    def no_truth(self) -> str:
        """Why the simulator cannot run beside this session; "" if it can."""
        return "not yet"

    def begun(self) -> None:
        """Forgets what belonged to the tree before."""
        self.sources.acting.clear()

    def close(self) -> None:
        """Frees everything; the session is over."""
        for task in self._tasks:
            task.cancel()
        self.session.forget()

    async def sourced(self, branch: Branch, source: dict[str, Any]) -> Float[np.ndarray, " A"]:
        """Returns the action of a source into a branch's next frame."""
        return await asyncio.to_thread(self.sources.action, self.session, branch, source)

    async def show(self, number: int, frame: int, answered: int) -> None:
        """Sends a new frame, and begins to make what else the page watches."""
        session = self.session
        nodes = session.grown.branch(number).nodes
        place, node = Place(number, frame, answered), nodes[frame]
        shown.send_rgb(session, place, node)
        if "uncertainty" in session.watched:
            shown.send_uncertainty(session, place, node)
        if "depth" in session.watched and session.has_depth and self.side.waiting < BACKLOG:
            self._later(shown.send_depth(session, self.side, place, node))

    async def again(self, place: Place, nodes: list[Node], kinds: list[str]) -> None:
        """Sends what there is of an older frame, the last of these."""
        session, node = self.session, nodes[-1]
        if session.out is not None:
            await session.out.room()
        if "rgb" in kinds:
            shown.send_rgb(session, place, node)
        if "uncertainty" in kinds:
            shown.send_uncertainty(session, place, node)
        if "depth" in kinds and session.has_depth:
            await shown.send_depth(session, self.side, place, node)

    def mean_bits(self, node: Node) -> float | None:
        """Returns the mean entropy of a frame's tokens in bits."""
        return None if node.moment.entropy is None else round(float(node.moment.entropy.mean() / np.log(2)), 4)

    def _later(self, work: Any) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
