"""What is in a store: counts, shapes, histograms, and a sheet of pictures.

Axes: T frames, H×W pixels, A action dimensions, N₀ tracks.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import UInt8

from rsjax.data.codec import Record
from rsjax.data.merge import NONE, shapes
from rsjax.data.store import Store, StoreError
from rsjax.tokenizer.depth_color import depth_to_color

BARS = " ▁▂▃▄▅▆▇█"
_GAP = 4  # pixels between pictures
_BACKGROUND = 30


@dataclass(frozen=True)
class Contents:
    """What :func:`look` finds.

    Attributes:
        splits: number of records by split.
        shapes: of the arrays of the first record.
        words: records by word, by column of the labels (task, difficulty …); the splits together.
        lengths: records by their number of frames.
        motion: of each record looked at: how far its visible tracks move from frame to frame, % of the image's side.
        actions: (dimensions, least, mean, greatest) over the records looked at.
        depth: records looked at that have depth, and how many were looked at.
        damaged: messages of records that cannot be read.
    """

    splits: dict[str, int]
    shapes: dict[str, str]
    words: dict[str, dict[str, int]]
    lengths: dict[int, int]
    motion: list[float]
    actions: tuple[int, float, float, float] | None
    depth: tuple[int, int]
    damaged: list[str] = field(default_factory=list)


def look(store: Store, most: int = 200) -> Contents:
    """Looks into a store of clips or of tokens.

    Args:
        most: how many records are read, spread evenly over the splits; counts and words are of all.
    """
    lengths, motion, depths = Counter[int](), [], 0
    damaged: list[str] = []
    sums = np.zeros(2)  # values and their number
    low, high, width = np.inf, -np.inf, 0
    looked = 0
    for record in sampled(store, most, damaged):
        looked += 1
        lengths[len(record["actions"])] += 1
        motion.append(motion_of(record))
        depths += record.get("depth") is not None
        actions = record["actions"][1:]
        if actions.size:
            sums += actions.sum(), actions.size
            low, high, width = min(low, actions.min()), max(high, actions.max()), actions.shape[-1]
    return Contents(
        splits={name: len(store.source(name)) for name in store.splits},
        shapes={} if damaged else shapes(store),
        words=_words(store),
        lengths=dict(sorted(lengths.items())),
        motion=motion,
        actions=(width, float(low), float(sums[0] / sums[1]), float(high)) if sums[1] else None,
        depth=(depths, looked),
        damaged=damaged,
    )


def motion_of(record: Record) -> float:
    """Mean distance that a record's tracks move to the next frame, where they are visible in both, in % of a side."""
    steps = np.linalg.norm(np.diff(record["tracks"], axis=1), axis=-1)
    seen = record["visible"][:, 1:] & record["visible"][:, :-1]
    return float(100 * steps[seen].mean()) if seen.any() else 0.0


def render(contents: Contents) -> list[str]:
    """As lines of text."""
    lines = [f"splits    {', '.join(f'{name} {count}' for name, count in contents.splits.items())}"]
    lines += [f"{name:<9} {shape}" for name, shape in contents.shapes.items() if shape != NONE]
    if contents.actions:
        width, low, mean, high = contents.actions
        lines.append(f"actions   {width} dimensions, {low:.3g} to {high:.3g}, mean {mean:.3g}")
    lines.append(f"depth     in {contents.depth[0]} of {contents.depth[1]} records read")
    lines.append("lengths   " + ", ".join(f"{length} frames {count}×" for length, count in contents.lengths.items()))
    lines.append(f"motion    {histogram(contents.motion)}")
    for column, words in contents.words.items():
        ranked = sorted(words.items(), key=lambda pair: -pair[1])
        told = ", ".join(f"{word!r} {count}×" for word, count in ranked[:10])
        lines.append(f"{column:<9} {told}" + (f", {len(ranked) - 10} more" if len(ranked) > 10 else ""))
    return lines + [f"damaged   {message}" for message in contents.damaged]


def histogram(values: Sequence[float], bins: int = 24) -> str:
    """A line such as ``0 ▁▃█▂ 4.2 % of a side per frame, median 1.3``."""
    if not values:
        return "not measured"
    counts, edges = np.histogram(values, bins)
    levels = np.ceil(counts / max(counts.max(), 1) * (len(BARS) - 1)).astype(int)
    bars = "".join(BARS[level] for level in levels)
    return f"{edges[0]:.3g} {bars} {edges[-1]:.3g} % of a side per frame, median {np.median(values):.3g}"


def contact_sheet(store: Store, clips: int = 12, frames: int = 8, side: int = 96) -> UInt8[np.ndarray, "h w 3"]:
    """Some clips as rows, spread evenly over the store, with ``frames`` of their frames each, and depth below them.

    Raises:
        StoreError: the store has no readable clip with pictures.
    """
    rows, damaged = [], list[str]()
    for record in sampled(store, clips, damaged):
        if record["rgb"].ndim != 4:
            raise StoreError(f"{store.path}: holds tokens, not pictures; inspect the store of clips that they are of")
        times = np.linspace(0, len(record["rgb"]) - 1, frames).round().astype(int)
        rows.append(_row(record["rgb"][times], side))
        if record.get("depth") is not None:
            depth = record["depth"]
            near, far = float(depth.min()), float(depth.max())
            colors = depth_to_color(depth[times], near, max(far, near * 1.001), "inverse")
            rows.append(_row(colors.astype(np.uint8), side))
    if not rows:
        raise StoreError(f"{store.path}: no clip can be read{f' ({damaged[0]})' if damaged else ''}; make it again")
    return np.concatenate(rows)


def sampled(store: Store, most: int, damaged: list[str]) -> Iterator[Record]:
    """Records spread evenly over all splits; what cannot be read is added to ``damaged``."""
    sources = [store.source(name) for name in store.splits]
    ends = np.cumsum([len(source) for source in sources])
    total = int(ends[-1]) if sources else 0
    for place in np.unique(np.linspace(0, total - 1, min(most, total)).round().astype(int)).tolist():
        part = int(np.searchsorted(ends, place, side="right"))
        try:
            yield sources[part][place - int(ends[part]) + len(sources[part])]
        except StoreError as error:
            damaged.append(str(error))


def _words(store: Store) -> dict[str, dict[str, int]]:
    found: dict[str, Counter[str]] = {}
    for name in store.splits:
        if store.labelled(name):
            for column, words in store.labels(name).counts().items():
                found.setdefault(column, Counter()).update(words)
    return {column: dict(words) for column, words in found.items()}


def _row(pictures: UInt8[np.ndarray, "n H W 3"], side: int) -> UInt8[np.ndarray, "h w 3"]:
    height = max(1, round(side * pictures.shape[1] / pictures.shape[2]))
    small = [cv2.resize(picture, (side, height), interpolation=cv2.INTER_AREA) for picture in pictures]
    framed = [np.pad(one, ((0, _GAP), (0, _GAP), (0, 0)), constant_values=_BACKGROUND) for one in small]
    return np.concatenate(framed, axis=1)
