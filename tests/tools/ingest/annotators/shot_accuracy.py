"""Measures how well cuts are detected where there certainly is one, between the episodes of a data set.

python -m tests.tools.ingest.annotators.shot_accuracy rlds ../shared/data/bridge --camera image_0 --method transnetv2
"""

import argparse
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from rsjax.errors import UserError
from rsjax.tools.commands.cli import main_errors
from rsjax.tools.ingest.annotators.choose import METHODS, choose
from rsjax.tools.ingest.annotators.protocols import ShotDetector
from rsjax.tools.ingest.formats import FORMATS, open_source
from tests.tools.ingest.videos import ArrayFrames


@dataclass(frozen=True)
class ShotAccuracy:
    """Counts over one video that joins the episodes.

    Attributes:
        cuts: between episodes.
        exact: of them detected to the frame.
        near: of them detected to the frame or one beside it.
        false: cuts detected elsewhere.
        inside: cuts detected in the episodes one by one, each of which is one shot.
    """

    cuts: int
    exact: int
    near: int
    false: int
    inside: int


def shot_accuracy(detect: ShotDetector, episodes: Sequence[UInt8[np.ndarray, "n H W 3"]]) -> ShotAccuracy:
    """Joins the episodes' pictures, all of one size, and compares the detected cuts with the true ones."""
    cuts = set(np.cumsum([len(pictures) for pictures in episodes])[:-1].tolist())
    found = {start for start, _ in detect(ArrayFrames(np.concatenate(list(episodes))))} - {0}
    around = {cut: {cut - 1, cut, cut + 1} & found for cut in cuts}
    return ShotAccuracy(
        cuts=len(cuts),
        exact=len(cuts & found),
        near=sum(bool(places) for places in around.values()),
        false=len(found - set[int]().union(*around.values())),
        inside=sum(len(detect(ArrayFrames(pictures))) - 1 for pictures in episodes),
    )


def pictures_of(kind: str, path: str, camera: str) -> list[UInt8[np.ndarray, "n H W 3"]]:
    """Reads one camera's pictures of every episode that has them in the size of the first.

    Raises:
        UserError: the data set cannot be read, or no episode has the camera.
    """
    source = open_source(kind, path)
    read = (source.read(ref) for ref in source.episodes())
    found = [e.cameras[camera].read(range(len(e.timestamps))) for e in read if camera in e.cameras]
    if not found:
        raise UserError(f"{path}: no episode has a camera {camera!r}; name one with --camera")
    return [pictures for pictures in found if pictures.shape[1:] == found[0].shape[1:]]


@main_errors()
def main(argv: Sequence[str] | None = None) -> None:
    """Prints the measurement of one method."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("format", choices=FORMATS)
    parser.add_argument("path")
    parser.add_argument("--camera", required=True)
    parser.add_argument("--method", default="hsv-histogram", help=f"one of {', '.join(METHODS['shots'])}")
    options = parser.parse_args(argv)
    method = choose("shots", options.method)
    print(shot_accuracy(method, pictures_of(options.format, options.path, options.camera)))


if __name__ == "__main__":
    main()
