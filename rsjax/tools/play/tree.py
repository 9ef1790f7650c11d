"""A tree of frames, branches that share their beginnings, and a bound on the memory that all frames keep."""

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from rsjax.models.branch_states import BranchState, Decoding
from rsjax.tools.play.messages import Refused

BYTES = 2**30  # of memory that the frames of all sessions keep


@dataclass(eq=False)
class Node:
    """One frame, and how it was made.

    Attributes:
        state: the frame; its memory may be used up.
        action: the action that led to the frame, after clipping; None for a first frame.
        decoding: how the frame was decoded; None for a first frame.
        truth: the simulator's frame after the same actions, once it is there.
        points: (K, 3) keypoints, x and y in 0–1 and whether they are seen, by pane; computed on request.
    """

    state: BranchState
    action: Float32[np.ndarray, " A"] | None = None
    decoding: Decoding | None = None
    truth: "Truth | None" = None
    points: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Truth:
    """The simulator's frame: rgb, depth in metres, whether the task is done, and the PSNR of the model's frame."""

    rgb: UInt8[np.ndarray, "H W 3"]
    depth: Float32[np.ndarray, "H W"]
    success: bool
    psnr: float | None  # dB; None if both frames are identical


@dataclass
class Branch:
    """A video, whose frames are nodes; a branch shares its first nodes with the branch that it forks from.

    Attributes:
        fork: the last frame shared with the parent.
        draw: determines, with the session's seed, the draws of the next frames.
    """

    number: int
    parent: int | None
    fork: int | None
    draw: int
    nodes: list[Node]

    def describe(self) -> dict[str, Any]:
        """Returns the description of the branch for a page."""
        facts = {"branch": self.number, "parent": self.parent, "fork": self.fork}
        return facts | {"length": len(self.nodes), "draw": self.draw}


class Tree:
    """The branches of one start."""

    def __init__(self, first: Node, draw: int) -> None:
        self.branches = {0: Branch(0, None, None, draw, [first])}
        self.frames = 1
        self._next = 1

    def branch(self, number: int) -> Branch:
        """Returns a branch; raises :class:`Refused` if there is none with this number."""
        if number not in self.branches:
            raise Refused("no_branch", f"there is no branch {number}")
        return self.branches[number]

    def node(self, number: int, frame: int) -> Node:
        """Returns a branch's frame; raises :class:`Refused` if there is none."""
        nodes = self.branch(number).nodes
        if not 0 <= frame < len(nodes):
            raise Refused("no_frame", f"branch {number} has frames 0 to {len(nodes) - 1}, not {frame}")
        return nodes[frame]

    def append(self, number: int, node: Node) -> int:
        """Adds a frame at a branch's end and returns its number."""
        self.branches[number].nodes.append(node)
        self.frames += 1
        return len(self.branches[number].nodes) - 1

    def fork(self, number: int, frame: int, draw: int | None) -> Branch:
        """Makes a branch that shares frames 0 … ``frame`` with another, and its draw too if ``draw`` is None."""
        self.node(number, frame)
        parent = self.branches[number]
        if draw is None:
            kept = parent.draw
        else:
            kept = draw
        made = Branch(self._next, number, frame, kept, parent.nodes[: frame + 1])
        self.branches[made.number] = made
        self._next += 1
        return made

    def drop(self, number: int) -> None:
        """Removes a branch from which no other branch forks."""
        branch = self.branch(number)
        if number == 0 or any(each.parent == number for each in self.branches.values()):
            raise Refused("no_branch", f"branch {number} cannot go: others fork from it, or it is the first")
        self.frames -= len(branch.nodes) - 1 - int(branch.fork or 0)
        del self.branches[number]


class Memories:
    """The frames with a large memory; when there is too much, the oldest frames lose theirs.

    Args:
        least: frames that keep their memory whatever its size: as many as there are sessions.
        most: bytes of memory that all frames together may keep.
    """

    def __init__(self, least: int, most: int = BYTES) -> None:
        self._least = least
        self._most = most
        self._bytes = 0
        self._nodes: OrderedDict[int, tuple[Node, int, Callable[[BranchState], BranchState]]] = OrderedDict()

    def note(self, node: Node, lighten: Callable[[BranchState], BranchState]) -> None:
        """Notes that a frame has a large memory, and how to remove it."""
        self._nodes[id(node)] = node, node.state.size, lighten
        self._bytes += node.state.size
        while self._bytes > self._most and len(self._nodes) > self._least:
            oldest, _, lighter = next(iter(self._nodes.values()))
            self.forget(oldest)
            oldest.state = lighter(oldest.state)

    def forget(self, node: Node) -> None:
        """Notes that a frame no longer has a large memory."""
        entry = self._nodes.pop(id(node), None)
        if entry is not None:
            self._bytes -= entry[1]
