"""A second camera's view of the same frames, as another stream of tokens on the RGB branch.

The branch reads the embeddings of both views' tokens, cell by cell (x = E_RGB + E_second, as with a depth head), and a
head of its own predicts the second view's. So both views share positions, actions, attention and cache, and a second
view costs an embedding and a head, not twice the cells. Cells of the two views that are added up need not show the same
place: their embeddings have tables of their own, and attention within the frame relates all cells to each other.

    L_second = -Σ_t w_t log p(ŵ_t), as L_RGB in Eq. 4, with the weight of L_RGB, 1.

A camera on the hand shows how fingers and object lie to each other where the first camera sees few pixels of both.
Ctrl-World (arXiv 2510.10125) predicts several views, one of them from the wrist, for the sake of contacts.
"""

from dataclasses import replace

from rsjax.clip import Video
from rsjax.errors import UserError

SECOND = "second"  # the name of the stream, and of its loss
WEIGHT = 1.0


class NoSecondView(UserError):
    """Frames to start from lack the second view that a model reads. The message names the cure."""


def views(video: Video, depth: bool, second: bool) -> Video:
    """Returns what a network reads of a video.

    Args:
        depth: whether it reads or predicts depth.
        second: whether it reads a second view.

    Raises:
        NoSecondView: the video lacks the second view.
    """
    if not depth:
        video = replace(video, depth=None)
    if not second:
        return replace(video, second=None)
    if video.second is None:
        raise NoSecondView(
            "the model was trained with sim.second_view and reads a second view in its first frames, which these lack; "
            "start from clips of its own simulator, or take a model of one view"
        )
    return video
