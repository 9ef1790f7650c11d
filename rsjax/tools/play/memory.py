"""Bounds the memory that the frames of all sessions keep so that generation can continue from them."""

from collections import OrderedDict
from collections.abc import Callable

from rsjax.models.branch_states import Moment
from rsjax.tools.play.tree import Node

BYTES = 2**30


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
        self._nodes: OrderedDict[int, tuple[Node, int, Callable[[Moment], Moment]]] = OrderedDict()

    def note(self, node: Node, lighten: Callable[[Moment], Moment]) -> None:
        """Notes that a frame has a large memory, and how to remove it."""
        self._nodes[id(node)] = node, node.moment.size, lighten
        self._bytes += node.moment.size
        while self._bytes > self._most and len(self._nodes) > self._least:
            oldest, _, lighter = next(iter(self._nodes.values()))
            self.forget(oldest)
            oldest.moment = lighter(oldest.moment)

    def forget(self, node: Node) -> None:
        """Notes that a frame no longer has a large memory."""
        found = self._nodes.pop(id(node), None)
        if found is not None:
            self._bytes -= found[1]
