"""Bounds what the frames of all sessions keep to go on from."""

from collections import OrderedDict
from collections.abc import Callable

from rsjax.models.moments import Moment
from rsjax.play.tree import Node

BYTES = 2**30


class Memories:
    """The frames with a large memory, of which those that were made longest ago lose it.

    Args:
        least: frames that keep theirs whatever its size: as many as there are sessions.
        most: bytes.
    """

    def __init__(self, least: int, most: int = BYTES) -> None:
        self._least, self._most, self._bytes = least, most, 0
        self._nodes: OrderedDict[int, tuple[Node, int, Callable[[Moment], Moment]]] = OrderedDict()

    def note(self, node: Node, lighten: Callable[[Moment], Moment]) -> None:
        """Says that a frame has a large memory, and how it loses it."""
        self._nodes[id(node)] = node, node.moment.size, lighten
        self._bytes += node.moment.size
        while self._bytes > self._most and len(self._nodes) > self._least:
            oldest, _, lighter = next(iter(self._nodes.values()))
            self.forget(oldest)
            oldest.moment = lighter(oldest.moment)

    def forget(self, node: Node) -> None:
        """Says that a frame has none any more."""
        found = self._nodes.pop(id(node), None)
        if found is not None:
            self._bytes -= found[1]
