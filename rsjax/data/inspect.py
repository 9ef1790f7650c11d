"""What is in a store: counts, shapes, histograms, and a sheet of pictures.

Axes: T frames, H×W pixels, A action dimensions, N₀ tracks.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from rsjax.data.codec import Record
from rsjax.data.depth_color import depth_to_color
from rsjax.data.store import NO_ARRAY, Store, StoreError
from rsjax.data.token_sets import token_sets

BARS = " ▁▂▃▄▅▆▇█"
_GAP = 4  # pixels between pictures
_CAPTION = 16  # pixels high
_BACKGROUND = 30
MOST_DIMENSIONS = 32  # of actions, whose means are told one by one
SIDE = "% of a side per frame"
SPEED = "px/s of a 256-pixel-wide picture (as --windows.least-motion)"


@dataclass(frozen=True)
class Contents:
    """What :func:`look` finds.

    Attributes:
        splits: number of records by split.
        shapes: of the arrays of the first record.
        words: records by word, by column of the labels (task, difficulty …); the splits together.
        lengths: records by their number of frames.
        motion: of each record looked at: how far its visible tracks move from frame to frame, % of the image's side.
        speed: of each that has it: pixels per second of a 256-pixel-wide picture, by the stage ``motion``.
        cameras: records looked at by the camera they are of, where they say it.
        rates: likewise by recorded rate and step, in words.
        actions: (dimensions, least, mean, greatest) over the records looked at.
        units: mean and deviation of each dimension of the train split's actions, as the manifest has them.
        depth: records looked at that have depth, and how many were looked at.
        episodes: by split, as the manifest has them.
        left_out: what the manifest counts of what is not in the store: episodes, windows, depth.
        tokens: records by split of each set of tokens that lies beside the clips.
        damaged: messages of records that cannot be read.
    """

    splits: dict[str, int]
    shapes: dict[str, str]
    words: dict[str, dict[str, int]]
    lengths: dict[int, int]
    motion: list[float]
    speed: list[float]
    cameras: dict[str, int]
    rates: dict[str, int]
    actions: tuple[int, float, float, float] | None
    units: list[tuple[float, float]]
    depth: tuple[int, int]
    episodes: dict[str, int]
    left_out: dict[str, int]
    tokens: dict[str, dict[str, int]]
    damaged: list[str] = field(default_factory=list)


def look(store: Store, most: int = 200) -> Contents:
    """Looks into a store of clips or of tokens.

    Args:
        most: how many records are read, spread evenly over the splits; counts and words are of all.
    """
    lengths, cameras, rates = Counter[int](), Counter[str](), Counter[str]()
    motion, speed, depths = list[float](), list[float](), 0
    damaged: list[str] = []
    sums = np.zeros(2)  # values and their number
    low, high, width = np.inf, -np.inf, 0
    looked = 0
    for _, _, record in sampled(store, most, damaged):
        looked += 1
        provenance = record["provenance"]
        lengths[len(record["actions"])] += 1
        motion.append(motion_of(record))
        speed += [provenance["motion"]] if "motion" in provenance else []
        cameras.update([provenance["camera"]] if "camera" in provenance else [])
        rates.update(_rate(provenance))
        depths += record.get("depth") is not None
        actions = record["actions"][1:]
        if actions.size:
            sums += actions.sum(), actions.size
            low, high, width = min(low, actions.min()), max(high, actions.max()), actions.shape[-1]
    return Contents(
        splits={name: len(store.source(name)) for name in store.splits},
        shapes={} if damaged else store.shapes(),
        words=_words(store),
        lengths=dict(sorted(lengths.items())),
        motion=motion,
        speed=speed,
        cameras=dict(cameras),
        rates=dict(rates),
        actions=(width, float(low), float(sums[0] / sums[1]), float(high)) if sums[1] else None,
        units=list(zip(store.manifest.get("action_mean", []), store.manifest.get("action_std", []), strict=False)),
        depth=(depths, looked),
        episodes={split: len(names) for split, names in store.manifest.get("episodes", {}).items()},
        left_out=_left_out(store),
        tokens={key: tokens.counts() for key, tokens in token_sets(store).items()},
        damaged=damaged,
    )


def _rate(provenance: dict[str, Any]) -> list[str]:
    """How a record's frames lie in its recording, if it says so."""
    fps, frames = provenance.get("fps"), provenance.get("frames", [])
    if not fps or len(frames) < 2:
        return []
    step = (frames[-1] - frames[0]) / (len(frames) - 1)
    return [f"{fps:.4g} fps, every {f'{step:.3g} frames' if step != 1 else 'frame'} ({fps / step:.3g} Hz)"]


def _left_out(store: Store) -> dict[str, int]:
    """By what it was that was left out; of a merged store, whose counts are gone, its lists of episodes."""
    told, manifest = store.manifest.get("counts", {}), store.manifest
    found = {
        "episodes without a clip": told.get("without", len(manifest.get("filtered", {}))),
        "episodes quarantined": told.get("quarantined", len(manifest.get("quarantine", {}))),
    }
    found |= {f"windows {reason}": count for reason, count in told.get("windows", {}).items() if reason != "kept"}
    return {what: count for what, count in (found | {"depths": told.get("depth_left_out", 0)}).items() if count}


def motion_of(record: Record) -> float:
    """Mean distance that a record's tracks move to the next frame, where they are visible in both, in % of a side."""
    steps = np.linalg.norm(np.diff(record["tracks"], axis=1), axis=-1)
    seen = record["visible"][:, 1:] & record["visible"][:, :-1]
    return float(100 * steps[seen].mean()) if seen.any() else 0.0


def render(contents: Contents) -> list[str]:
    """As lines of text."""
    lines = [f"splits    {_counted(contents.splits)}"]
    lines += [f"tokens    {key}: {_counted(splits)}" for key, splits in contents.tokens.items()]
    lines += [f"episodes  {_counted(contents.episodes)}"] if contents.episodes else []
    lines += [f"left out  {_counted(contents.left_out)}"] if contents.left_out else []
    lines += [f"cameras   {_counted(contents.cameras)}"] if contents.cameras else []
    lines += [f"rate      {rate} {count}×" for rate, count in contents.rates.items()]
    lines += [f"{name:<9} {shape}" for name, shape in contents.shapes.items() if shape != NO_ARRAY]
    if contents.actions:
        width, low, mean, high = contents.actions
        lines.append(f"actions   {width} dimensions, {low:.3g} to {high:.3g}, mean {mean:.3g}")
    if 0 < len(contents.units) <= MOST_DIMENSIONS:
        lines.append(f"mean±std  {', '.join(f'{mean:.3g}±{std:.2g}' for mean, std in contents.units)}")
    lines.append(f"depth     in {contents.depth[0]} of {contents.depth[1]} records read")
    lines.append("lengths   " + ", ".join(f"{length} frames {count}×" for length, count in contents.lengths.items()))
    lines.append(f"tracks    {histogram(contents.motion, SIDE)}")
    if contents.speed:
        lines.append(f"motion    {histogram(contents.speed, SPEED)}")
    for column, words in contents.words.items():
        ranked = sorted(words.items(), key=lambda pair: -pair[1])
        told = ", ".join(f"{word!r} {count}×" for word, count in ranked[:10])
        lines.append(f"{column:<9} {told}" + (f", {len(ranked) - 10} more" if len(ranked) > 10 else ""))
    return lines + [f"damaged   {message}" for message in contents.damaged]


def histogram(values: Sequence[float], unit: str, bins: int = 24) -> str:
    """A line such as ``0 ▁▃█▂ 4.2 % of a side per frame, median 1.3``."""
    if not values:
        return "not measured"
    heights, edges = np.histogram(values, bins)
    levels = np.ceil(heights / max(heights.max(), 1) * (len(BARS) - 1)).astype(int)
    bars = "".join(BARS[level] for level in levels)
    return f"{edges[0]:.3g} {bars} {edges[-1]:.3g} {unit}, median {np.median(values):.3g}"


def contact_sheet(store: Store, clips: int = 12, frames: int = 8, side: int = 96) -> UInt8[np.ndarray, "h w 3"]:
    """Some clips as rows, spread evenly over the store, with ``frames`` of their frames each, and depth below them.

    Above each clip stands its split, its number there and its task.

    Raises:
        StoreError: the store has no readable clip with pictures.
    """
    rows, damaged = [], list[str]()
    for split, number, record in sampled(store, clips, damaged):
        if record["rgb"].ndim != 4:
            raise StoreError(f"{store.path}: holds tokens, not pictures; inspect the store of clips that they are of")
        times = np.linspace(0, len(record["rgb"]) - 1, frames).round().astype(int)
        pictures = _row(record["rgb"][times], side)
        rows += [_caption(f"{split} {number}: {record['task']}", pictures.shape[1]), pictures]
        if record.get("depth") is not None:
            depth = record["depth"]
            near, far = float(depth.min()), float(depth.max())
            colors = depth_to_color(depth[times], near, max(far, near * 1.001), "inverse")
            rows.append(_row(colors.astype(np.uint8), side))
    if not rows:
        raise StoreError(f"{store.path}: no clip can be read{f' ({damaged[0]})' if damaged else ''}; make it again")
    return np.concatenate(rows)


def sampled(store: Store, most: int, damaged: list[str]) -> Iterator[tuple[str, int, Record]]:
    """Records spread evenly over all splits, with split and number; what cannot be read is added to ``damaged``."""
    sources = [store.source(name) for name in store.splits]
    ends = np.cumsum([len(source) for source in sources])
    total = int(ends[-1]) if sources else 0
    for place in np.unique(np.linspace(0, total - 1, min(most, total)).round().astype(int)).tolist():
        part = int(np.searchsorted(ends, place, side="right"))
        number = place - int(ends[part]) + len(sources[part])
        try:
            yield store.splits[part], number, sources[part][number]
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


def _caption(text: str, width: int) -> UInt8[np.ndarray, "h w 3"]:
    """A line of small text, cut off where the width ends; letters that OpenCV has not are question marks."""
    strip = np.full((_CAPTION, width, 3), _BACKGROUND, np.uint8)
    shown = " ".join(text.split()).encode("ascii", "replace").decode()
    cv2.putText(strip, shown, (_GAP, _CAPTION - 5), cv2.FONT_HERSHEY_SIMPLEX, 0.38, (230, 230, 230), 1, cv2.LINE_AA)
    return strip


def _counted(numbers: dict[str, int]) -> str:
    """As in ``train 7, test 2``."""
    return ", ".join(f"{name} {number}" for name, number in numbers.items())
