"""Step "semantics": the text and key frames of each part. Without weights: the data set's own text.

Key frames are those in which a gripper opens or closes; without such a change or a known gripper, the frame with most
motion.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from rsjax.tools.ingest.actions import Layout
from rsjax.tools.ingest.annotators.protocols import Annotator, Semantic, Semantics
from rsjax.tools.ingest.episode import Episode, Segment


@dataclass(frozen=True)
class OwnSemantics(Annotator):
    """The data set's own language and segments; without segments, the whole episode is one part.

    Attributes:
        least_grip: how far a gripper's command has to move over the episode to count as used, in the data set's unit
            (mostly 0–1 or -1–1).
        smooth: frames over which motion is averaged before its peak is taken.
    """

    name: ClassVar[str] = "own"
    least_grip: float = 0.1
    smooth: int = 5

    def __call__(self, episode: Episode, camera: str, motion: Float[np.ndarray, " N"] | None = None) -> Semantics:
        changes, parts = gripper_changes(episode, self.least_grip), []
        for segment in episode.segments or (Segment(0, len(episode.timestamps), ""),):
            frames, by = key_frames(segment, changes, motion, self.smooth)
            text, text_by = (segment.text, "segment") if segment.text else (episode.task, episode.task and "task")
            parts.append(Semantic(segment.start, segment.end, text, segment.skill, frames, text_by, by))
        return Semantics(episode.task, str(episode.meta.get("scene", "")), tuple(parts))


def key_frames(
    segment: Segment, changes: list[int], motion: Float[np.ndarray, " N"] | None, smooth: int
) -> tuple[tuple[int, ...], str]:
    """Returns a segment's key frames and their origin: "gripper", "motion" or, if nothing moves, "".

    Args:
        changes: frames of the episode at which a gripper opens or closes.
        motion: motion into each frame of the episode; None if it was not measured.
        smooth: frames over which motion is averaged.
    """
    if inside := tuple(t for t in changes if segment.start <= t < segment.end):
        return inside, "gripper"
    if motion is None or not (within := motion[segment.start : segment.end]).any():
        return (), ""
    width = min(smooth, len(within))
    evened = np.convolve(within, np.full(width, 1 / width), "same")
    return (segment.start + int(evened.argmax()),), "motion"


def gripper_changes(episode: Episode, least: float) -> list[int]:
    """Returns the frames in which a gripper begins to open or close.

    There, its command passes from the lower third of its range to the upper third, or back.

    Args:
        episode: its ``meta["actions"]`` lists the dimensions of gripper commands; without such a list it has none.
        least: a command that moves less than this over the whole episode is ignored.
    """
    changes = set[int]()
    for dimension in Layout.from_json(episode.meta.get("actions", {})).held:
        command = episode.actions[1:, dimension]  # row 0 of the actions is zeros
        if not len(command) or np.ptp(command) < least:
            continue
        position = (command - command.min()) / np.ptp(command)
        sure = np.flatnonzero((position < 1 / 3) | (position > 2 / 3))  # between these thirds the last state holds
        closed = position[sure] > 0.5
        changes.update((sure[1:][closed[1:] != closed[:-1]] + 1).tolist())
    return sorted(changes)
