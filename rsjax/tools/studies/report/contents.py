"""Describes the contents of a store as text: counts, shapes and histograms."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from rsjax.data.codec import Record
from rsjax.data.store import NO_ARRAY, Store, StoreError
from rsjax.data.token_sets import token_sets

BARS = " ▁▂▃▄▅▆▇█"
MOST_DIMENSIONS = 32  # actions with at most this many dimensions get a line for each dimension
MOST_WORDS = 10  # labels listed per column
TRACK_UNIT = "% of a side per frame"
MOTION_UNIT = "px/s of a 256-pixel-wide picture (as --windows.least-motion)"


def describe(store: Store, most: int = 200) -> tuple[list[str], list[str]]:
    """Describes a store of clips or of tokens.

    Args:
        most: how many records are read, spread evenly over the splits; counts and labels cover all records.

    Returns:
        Lines of text, and the messages of damaged records, which the lines include as well.
    """
    damaged: list[str] = []
    lengths = Counter[int]()
    cameras = Counter[str]()
    rates = Counter[str]()
    tracks = list[float]()
    speeds = list[float]()
    actions = list[np.ndarray]()
    deep = 0
    for _, _, record in sampled(store, most, damaged):
        provenance = record["provenance"]
        lengths[len(record["actions"])] += 1
        tracks.append(motion_of(record))
        if "motion" in provenance:
            speeds.append(provenance["motion"])
        if "camera" in provenance:
            cameras[provenance["camera"]] += 1
        rates.update(_rate(provenance))
        actions.append(record["actions"][1:])
        deep += record.get("depth") is not None
    manifest = store.manifest
    episodes = {split: len(ids) for split, ids in (manifest.get("episodes") or {}).items()}
    figures = zip((manifest.get("action_mean") or []), (manifest.get("action_std") or []), strict=False)
    units = [f"{mean:.3g}±{std:.2g}" for mean, std in figures]
    named = [("mean±std", ", ".join(units))]  # one line for all dimensions if their names are not known
    names = manifest.get("action_dimensions") or []
    if len(names) == len(units):
        named = [(f"action {place}", f"{name} {units[place]}") for place, name in enumerate(names)]
    lines = [("splits", _counted(store.counts()))]
    lines += [("tokens", f"{key}: {_counted(tokens.counts())}") for key, tokens in token_sets(store).items()]
    lines += [
        ("episodes", _counted(episodes)),
        ("left out", _counted(left_out(manifest))),
        ("cameras", _counted(cameras)),
    ]
    lines += [("rate", f"{rate} {count}×") for rate, count in rates.items()]
    if not damaged:
        lines += [(name, shape) for name, shape in store.shapes().items() if shape != NO_ARRAY]
    if rows := [one for one in actions if one.size]:
        low = min(one.min() for one in rows)
        high = max(one.max() for one in rows)
        mean = sum(float(one.sum()) for one in rows) / sum(one.size for one in rows)
        lines.append(("actions", f"{rows[0].shape[-1]} dimensions, {low:.3g} to {high:.3g}, mean {mean:.3g}"))
    if len(named) <= MOST_DIMENSIONS:
        lines += named
    lines += [
        ("depth", f"in {deep} of {len(tracks)} records read"),
        ("lengths", ", ".join(f"{length} frames {count}×" for length, count in sorted(lengths.items()))),
        ("tracks", histogram(tracks, TRACK_UNIT)),
    ]
    if speeds:
        lines.append(("motion", histogram(speeds, MOTION_UNIT)))
    lines += _labels(store)
    lines += [("damaged", message) for message in damaged]
    return [f"{name:<9} {text}" for name, text in lines if text], damaged


def left_out(manifest: Mapping[str, Any]) -> dict[str, int]:
    """Returns how much was left out of a store, by reason; for a merged store, which has no counts, only episodes."""
    counts = manifest.get("counts") or {}
    reasons = {
        "episodes without a clip": counts.get("without", len(manifest.get("filtered") or {})),
        "episodes quarantined": counts.get("quarantined", len(manifest.get("quarantine") or {})),
        **{f"windows {reason}": count for reason, count in counts.get("windows", {}).items() if reason != "kept"},
        "depths": counts.get("depth_left_out", 0),
    }
    return {reason: count for reason, count in reasons.items() if count}


def motion_of(record: Record) -> float:
    """Returns the mean distance that tracks move between frames in which they are visible, in % of a side per frame."""
    steps = np.linalg.norm(np.diff(record["tracks"], axis=1), axis=-1)
    visible = record["visible"][:, 1:] & record["visible"][:, :-1]
    if not visible.any():
        return 0.0
    return float(100 * steps[visible].mean())


def histogram(values: Sequence[float], unit: str, bins: int = 24) -> str:
    """Returns a line such as ``0 ▁▃█▂ 4.2 % of a side per frame, median 1.3``."""
    if not values:
        return "not measured"
    heights, edges = np.histogram(values, bins)
    levels = np.ceil(heights / max(heights.max(), 1) * (len(BARS) - 1)).astype(int)
    bars = "".join(BARS[level] for level in levels)
    return f"{edges[0]:.3g} {bars} {edges[-1]:.3g} {unit}, median {np.median(values):.3g}"


def clips_of(store: Store, most: int, damaged: list[str]) -> Iterator[tuple[str, int, Record]]:
    """Yields clips as :func:`sampled` does, and checks that they have pictures.

    Raises:
        StoreError: the store contains tokens, or no clip can be read.
    """
    none = True
    for split, number, record in sampled(store, most, damaged):
        if record["rgb"].ndim != 4:
            raise StoreError(f"{store.path}: holds tokens, not pictures; open the store of clips that they are of")
        none = False
        yield split, number, record
    if none:
        raise StoreError(f"{store.path}: no clip can be read{f' ({damaged[0]})' if damaged else ''}; make it again")


def sampled(store: Store, most: int, damaged: list[str]) -> Iterator[tuple[str, int, Record]]:
    """Yields split, number and record of records that are spread evenly over all splits.

    Args:
        most: the largest number of records.
        damaged: a list to which the messages of unreadable records are added.
    """
    sources = [store.source(split) for split in store.splits]
    ends = np.cumsum([len(source) for source in sources])
    total = int(ends[-1]) if sources else 0
    for place in np.unique(np.linspace(0, total - 1, min(most, total)).round().astype(int)).tolist():
        part = int(np.searchsorted(ends, place, side="right"))
        number = place - int(ends[part]) + len(sources[part])
        try:
            yield store.splits[part], number, sources[part][number]
        except StoreError as error:
            damaged.append(str(error))


def _rate(provenance: Mapping[str, Any]) -> list[str]:
    """Returns, in words, at which rate a record's frames were taken from its recording, if its provenance says so."""
    fps = provenance.get("fps")
    frames = provenance.get("frames", [])
    if not fps or len(frames) < 2:
        return []
    step = (frames[-1] - frames[0]) / (len(frames) - 1)
    if times := provenance.get("times"):
        return [f"uneven, about {(len(times) - 1) / (times[-1] - times[0]):.2g} Hz"]
    every = "frame"
    if step != 1:
        every = f"{step:.3g} frames"
    return [f"{fps:.4g} fps, every {every} ({fps / step:.3g} Hz)"]


def _labels(store: Store) -> list[tuple[str, str]]:
    """Returns, for each column of labels, the most frequent labels over all splits with their numbers of records."""
    words: dict[str, Counter[str]] = {}
    for split in filter(store.labelled, store.splits):
        for column, counts in store.labels(split).counts().items():
            words.setdefault(column, Counter()).update(counts)
    lines = []
    for column, counted in words.items():
        shown = [f"{word!r} {count}×" for word, count in counted.most_common(MOST_WORDS)]
        if len(counted) > MOST_WORDS:
            shown.append(f"{len(counted) - MOST_WORDS} more")
        lines.append((column, ", ".join(shown)))
    return lines


def _counted(numbers: Mapping[str, int]) -> str:
    """Returns text such as ``train 7, test 2``."""
    return ", ".join(f"{name} {number}" for name, number in numbers.items())
