"""Stage "semantics": what is done when, and in which frames it is decided. Without weights: what the data set says.

Text is the data set's own, and nothing where it is silent. Key frames are where a gripper opens or closes; where it
does not, or is not known, the frame in which most moves.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from rsjax.ingest.actions import Layout
from rsjax.ingest.annotators.protocols import Semantic, Semantics, require_counts
from rsjax.ingest.episode import Episode, Segment


@dataclass(frozen=True)
class OwnSemantics:
    """The data set's own language and segmentation.

    Attributes:
        least_grip: how far a gripper's command has to move over the episode to count as used, in the data set's unit
            of it (mostly 0–1 or -1–1).
        smooth: frames over which motion is averaged before its peak is taken.
    """

    name: ClassVar[str] = "own"
    version: ClassVar[int] = 1
    least_grip: float = 0.1
    smooth: int = 5

    def __post_init__(self) -> None:
        require_counts(self, "smooth")

    def __call__(self, episode: Episode, camera: str, motion: Float[np.ndarray, " N"] | None = None) -> Semantics:
        changes = gripper_changes(episode, self.least_grip)
        parts = tuple(self._part(episode, segment, changes, motion) for segment in parts_of(episode))
        return Semantics(episode.task, str(episode.meta.get("scene", "")), parts)

    def _part(
        self, episode: Episode, segment: Segment, changes: list[int], motion: Float[np.ndarray, " N"] | None
    ) -> Semantic:
        frames, by = key_frames(segment, changes, motion, self.smooth)
        text, text_by = (segment.text, "segment") if segment.text else (episode.task, "task" if episode.task else "")
        return Semantic(segment.start, segment.end, text, segment.skill, frames, text_by, by)


def parts_of(episode: Episode) -> tuple[Segment, ...]:
    """The data set's segments, or the whole episode as one without text."""
    return episode.segments or (Segment(0, len(episode.timestamps), ""),)


def key_frames(
    segment: Segment, changes: list[int], motion: Float[np.ndarray, " N"] | None, smooth: int
) -> tuple[tuple[int, ...], str]:
    """A segment's key frames and what they were found by: "gripper", "motion" or, where nothing moves, "".

    Args:
        changes: frames of the episode at which a gripper opens or closes.
        motion: into each frame of the episode; None: not measured.
        smooth: frames that motion is averaged over.
    """
    if inside := tuple(t for t in changes if segment.start <= t < segment.end):
        return inside, "gripper"
    if motion is None or not (within := motion[segment.start : segment.end]).any():
        return (), ""
    width = min(smooth, len(within))
    evened = np.convolve(within, np.full(width, 1 / width), "same")
    return (segment.start + int(evened.argmax()),), "motion"


def gripper_changes(episode: Episode, least: float) -> list[int]:
    """Frames in which a gripper begins to open or close: its command passes from one third of its range to the other.

    Args:
        episode: its ``meta["actions"]`` says which dimensions hold a gripper's command; none where it does not.
        least: a command that moves less than this over the whole episode is not used.
    """
    layout = Layout.from_json(episode.meta.get("actions", {}))
    changes = set[int]()
    for dimension in layout.held:
        changes.update(_flips(episode.actions[1:, dimension], least))
    return sorted(t + 1 for t in changes)  # row 0 of the actions says nothing


def _flips(command: Float[np.ndarray, " N"], least: float) -> list[int]:
    if not len(command) or np.ptp(command) < least:
        return []
    position = (command - command.min()) / np.ptp(command)
    sure = np.flatnonzero((position < 1 / 3) | (position > 2 / 3))  # between the thirds the last one counts
    closed = position[sure] > 0.5
    return sure[1:][closed[1:] != closed[:-1]].tolist()
