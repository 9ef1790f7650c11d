"""Judges video files and stores of clips, by their marks and by their pictures."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from rsjax.clip import GENERATED, GENERATED_MARK
from rsjax.data.clips import readable
from rsjax.data.store import open_store
from rsjax.errors import UserError
from rsjax.tools.detector.spectra import MOST_FRAMES, Detector, video_features
from rsjax.tools.ingest.video import VideoFrames, open_container


def judged(detector: Detector, path: Path, split: str) -> Iterator[str]:
    """Yields a line for a video, or for each clip of a split of a store.

    A line has the probability that the pictures are generated, what that means, and whether a mark says so.

    Raises:
        UserError: there is nothing to judge, or it cannot be read.
    """
    if not path.is_dir():
        with open_container(path) as container:
            marked = GENERATED_MARK in str(container.metadata.get("comment", ""))
        frames = VideoFrames(path)
        count = min(len(frames), MOST_FRAMES)
        yield verdict(detector, frames.read(range(count)), marked, str(path))
        return
    store = open_store(path)
    if split not in store.splits:
        raise UserError(f"{path}: has no split {split!r} ({', '.join(store.splits)}); choose one with --split")
    for number, clip in readable(store.source(split)):
        marked = clip["provenance"].get("source") == GENERATED
        yield verdict(detector, clip["rgb"], marked, f"{path}, {split} {number}")


def verdict(detector: Detector, frames: UInt8[np.ndarray, "T H W 3"], marked: bool, name: str) -> str:
    """Returns a video's line."""
    probability = float(detector(video_features(frames)[None])[0])
    looks = "recorded"
    if probability > 0.5:
        looks = "generated"
    mark = ""
    if marked:
        mark = "; marked as generated"
    return f"{probability:.3f}  looks {looks}{mark}  {name}"
