"""How exact weights-free tracks and depth colours are, measured on a simulator's clips.

python -m rsjax.ingest.accuracy data/lift-4d419252e972e2e4 --split test
"""

import argparse
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from rsjax.clip import Clip
from rsjax.data.depth_color import Scale, color_to_depth, depth_to_color
from rsjax.data.store import decode_clip, open_store
from rsjax.errors import UserError
from rsjax.ingest.annotators.tracks import Follower, LucasKanade


@dataclass(frozen=True)
class TrackAccuracy:
    """Over the points that are visible in truth and still followed, frame 0 left out.

    Attributes:
        places: how many points in how many frames those are.
        median: distance from the truth, in pixels.
        within: share of them within 1, 2 and 4 pixels.
        followed: their share of all points that are visible in truth.
        false: share of the followed points that are hidden in truth.
    """

    places: int
    median: float
    within: tuple[float, float, float]
    followed: float
    false: float


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
    """Of all clips together.

    Args:
        follow: the method.
        moving_only: leave out points that have not moved so far: those of table and wall are easy.
    """
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
        within=tuple(float((both <= limit).mean()) for limit in (1, 2, 4)),  # type: ignore[arg-type]
        followed=len(both) / visible.sum(),
        false=float(1 - visible[seen.astype(bool)].mean()),
    )


def single_steps(clip: Clip) -> Iterator[Clip]:
    """Each two frames that follow each other as a clip of their own, with the points visible in the first."""
    for t in range(len(clip.rgb) - 1):
        there, both = clip.visible[:, t], slice(t, t + 2)
        tracks, visible = clip.tracks[there, both], clip.visible[there, both]
        depth = None if clip.depth is None else clip.depth[both]
        yield replace(clip, rgb=clip.rgb[both], depth=depth, tracks=tracks, visible=visible)


def color_round_trip(clips: Iterable[Clip], near: float, far: float, scale: Scale) -> tuple[float, float, float]:
    """Depth to 8-bit colours and back: mean and greatest error in metres, and mean error relative to the depth.

    Clips without depth are passed over; one at least has some.
    """
    total, greatest, relative, count = 0.0, 0.0, 0.0, 0
    for depth in (clip.depth for clip in clips if clip.depth is not None):
        colors = depth_to_color(depth, near, far, scale).astype(np.uint8)
        wanted = depth.clip(near, far)
        error = np.abs(color_to_depth(colors, near, far, scale) - wanted)
        total, greatest = total + float(error.sum(dtype=np.float64)), max(greatest, float(error.max()))
        relative, count = relative + float((error / wanted).sum(dtype=np.float64)), count + error.size
    return total / count, greatest, relative / count


def main() -> None:
    """Prints both measurements for one split of a store of clips."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("store")
    parser.add_argument("--split", default="test")
    options = parser.parse_args()
    store = open_store(options.store)
    if options.split not in store.splits:
        raise UserError(f"{store.path}: no split {options.split!r}; it has {', '.join(store.splits)}")
    source = store.source(options.split)
    clips = [decode_clip(source[i]) for i in range(len(source))]
    if not clips:
        raise UserError(f"{store.path}: split {options.split!r} has no clips; name another with --split")
    print(f"{len(clips)} clips of {clips[0].rgb.shape[1]} × {clips[0].rgb.shape[2]} pixels")
    steps = [step for clip in clips for step in single_steps(clip)]
    parts = (
        ("whole clips, all points", clips, False),
        ("whole clips, moving points", clips, True),
        ("single steps, moving points", steps, True),
    )
    for name, measured, moving_only in parts:
        made = track_accuracy(measured, LucasKanade().follow, moving_only)
        shares = ", ".join(f"{share:.1%}" for share in made.within)
        print(
            f"{name}: median {made.median:.3f} px; within 1, 2, 4 px: {shares}; followed {made.followed:.1%} of the "
            f"visible; {made.false:.1%} of the followed are hidden in truth; {made.places} places"
        )
    if store.manifest["depth_range"] is None or store.manifest.get("depth_unit", "metres") != "metres":
        print("depth colours: not measured, the clips have no depth in metres")
        return
    near, far = store.manifest["depth_range"]
    for scale in ("inverse", "linear"):
        mean, greatest, relative = color_round_trip(clips, near, far, scale)  # type: ignore[arg-type]
        print(
            f"depth colours, {scale}: mean {mean * 1e3:.3f} mm, greatest {greatest * 1e3:.3f} mm, AbsRel {relative:.2e}"
        )


def one_line(command: Callable[[], None]) -> None:
    """Runs a command; an error that the user can cure is one line, with exit status 2."""
    try:
        command()
    except UserError as error:
        print(f"error: {' '.join(str(error).split())}", file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    one_line(main)
