"""Measures how exact Lucas–Kanade tracks and depth colours are on a simulator's clips, as docs/annotate.md reports.

python -m tests.tools.ingest.annotators.track_accuracy data/lift-46219f98a81b280a --split test
"""

import argparse
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from rsjax.clip import Clip
from rsjax.data.depth_color import Scale, color_to_depth, depth_to_color
from rsjax.data.store import open_store
from rsjax.tools.commands.cli import main_errors
from rsjax.tools.ingest.annotators.tracks import Follower, LucasKanade


@dataclass(frozen=True)
class TrackAccuracy:
    """Accuracy of the points that are visible in truth and still followed, frame 0 left out.

    Attributes:
        places: pairs of such a point and a frame.
        median: distance from the truth, in pixels.
        within: share of them within 1, 2 and 4 pixels.
        followed: their share of all points that are visible in truth.
        false: share of the followed points that are hidden in truth.
    """

    places: int
    median: float
    within: tuple[float, ...]
    followed: float
    false: float

    def __str__(self) -> str:
        shares = ", ".join(f"{share:.1%}" for share in self.within)
        return (
            f"median {self.median:.3f} px; within 1, 2, 4 px: {shares}; followed {self.followed:.1%} of the visible; "
            f"{self.false:.1%} of the followed are hidden in truth; {self.places} places"
        )


def track_errors(
    clip: Clip, follow: Follower
) -> tuple[Float[np.ndarray, "P T"], Bool[np.ndarray, "P T"], Bool[np.ndarray, "P T"]]:
    """Follows a clip's own points from frame 0: distance from the truth in pixels, whether followed, whether moving.

    A point is moving in a frame if it was ever more than a pixel away from where it began.
    """
    size = np.array(clip.rgb.shape[2:0:-1])
    points, seen = follow(clip.rgb, clip.tracks[:, 0], clip.depth)
    away = np.linalg.norm((clip.tracks - clip.tracks[:, :1]) * size, axis=-1)
    return np.linalg.norm((points - clip.tracks) * size, axis=-1), seen, np.maximum.accumulate(away, 1) > 1


def track_accuracy(clips: Iterable[Clip], follow: Follower, moving_only: bool = False) -> TrackAccuracy:
    """Measures all clips together; ``moving_only`` leaves out points that have not moved, such as a table's."""
    rows = []
    for clip in clips:
        distance, seen, moving = track_errors(clip, follow)
        counts = (moving if moving_only else np.ones_like(moving))[:, 1:]
        rows.append(np.stack([x[:, 1:][counts].astype(np.float64) for x in (distance, seen, clip.visible)]))
    distance, seen, visible = np.concatenate(rows, 1)
    both = distance[(seen * visible).astype(bool)]
    return TrackAccuracy(
        places=len(both),
        median=float(np.median(both)),
        within=tuple(float((both <= limit).mean()) for limit in (1, 2, 4)),
        followed=len(both) / visible.sum(),
        false=float(1 - visible[seen.astype(bool)].mean()),
    )


def single_steps(clip: Clip) -> Iterator[Clip]:
    """Cuts a clip into pairs of consecutive frames, each with the points visible in its first one."""
    for t in range(len(clip.rgb) - 1):
        there = clip.visible[:, t]
        both = slice(t, t + 2)
        tracks = clip.tracks[there, both]
        visible = clip.visible[there, both]
        depth = None if clip.depth is None else clip.depth[both]
        yield replace(clip, rgb=clip.rgb[both], depth=depth, tracks=tracks, visible=visible)


def color_round_trip(clips: Iterable[Clip], near: float, far: float, scale: Scale) -> tuple[float, float, float]:
    """Returns the mean and greatest error in metres, and AbsRel, of depth turned into 8-bit colours and back."""
    total = 0.0
    greatest = 0.0
    relative = 0.0
    count = 0
    for depth in (clip.depth for clip in clips if clip.depth is not None):
        colors = depth_to_color(depth, near, far, scale).astype(np.uint8)
        wanted = depth.clip(near, far)
        error = np.abs(color_to_depth(colors, near, far, scale) - wanted)
        total = total + float(error.sum(dtype=np.float64))
        greatest = max(greatest, float(error.max()))
        relative = relative + float((error / wanted).sum(dtype=np.float64))
        count = count + error.size
    return total / count, greatest, relative / count


@main_errors()
def main(argv: Sequence[str] | None = None) -> None:
    """Prints both measurements of one split of a store of clips with depth in metres."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("store")
    parser.add_argument("--split", default="test")
    options = parser.parse_args(argv)
    store = open_store(options.store)
    source = store.source(options.split)
    clips = [Clip(**source[i]) for i in range(len(source))]
    steps = [step for clip in clips for step in single_steps(clip)]
    print(f"{len(clips)} clips of {clips[0].rgb.shape[1]} × {clips[0].rgb.shape[2]} pixels")
    print("whole clips, all points:", track_accuracy(clips, LucasKanade().follow))
    print("whole clips, moving points:", track_accuracy(clips, LucasKanade().follow, moving_only=True))
    print("single steps, moving points:", track_accuracy(steps, LucasKanade().follow, moving_only=True))
    near, far = store.manifest["depth_range"]
    scales: tuple[Scale, Scale] = ("inverse", "linear")
    for scale in scales:
        mean, most, relative = color_round_trip(clips, near, far, scale)
        print(f"depth colours, {scale}: mean {mean * 1e3:.3f} mm, greatest {most * 1e3:.3f} mm, AbsRel {relative:.2e}")


if __name__ == "__main__":
    main()
