"""Stacks whole clips of a split, for evaluation, figures and videos.

Axes: B clips, T frames, H×W pixels, A action dimensions, N₀ tracks.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Sized
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int, UInt8

from rsjax.clip import Video
from rsjax.data.codec import Record
from rsjax.data.state_labels import state_labels
from rsjax.data.store import RecordSource, Store, StoreError
from rsjax.progress import note


@dataclass(frozen=True)
class Clips:
    """The fields of :class:`rsjax.clip.Clip` for several clips, along a leading axis.

    Attributes:
        index: each clip's number in the split.
        depth: zeros for clips without depth.
        has_depth: whether a clip has depth.
        state: as of :func:`rsjax.data.state_labels.state_labels`.
        metric: whether a clip's depth is in metres rather than relative (see ``tools/ingest/annotators/depth.py``).
        second: None unless all clips have a second view.
    """

    index: Int[np.ndarray, " B"]
    rgb: UInt8[np.ndarray, "B T H W 3"]
    depth: Float32[np.ndarray, "B T H W"]
    has_depth: Bool[np.ndarray, " B"]
    metric: Bool[np.ndarray, " B"]
    actions: Float32[np.ndarray, "B T A"]
    tracks: Float32[np.ndarray, "B N0 T 2"]
    visible: Bool[np.ndarray, "B N0 T"]
    success: Bool[np.ndarray, "B T"]
    state: Float32[np.ndarray, "B T 3"]
    task: tuple[str, ...]
    second: UInt8[np.ndarray, "B T H W 3"] | None = None

    @classmethod
    def stacked(cls, records: Sequence[Record], index: Sequence[int]) -> "Clips":
        """Stacks records of clips, all of one shape; ``index`` has their numbers."""
        fields = {
            name: np.stack([record[name] for record in records])
            for name in ("rgb", "actions", "tracks", "visible", "success")
        }
        none = np.zeros(records[0]["rgb"].shape[:3], np.float32)
        has = np.array([record["depth"] is not None for record in records])
        metres = [record["provenance"].get("depth_unit", "metres") == "metres" for record in records]
        second = None
        if all(record.get("second") is not None for record in records):
            second = np.stack([record["second"] for record in records])
        return cls(
            second=second,
            index=np.array(index),
            depth=np.stack([none if record["depth"] is None else record["depth"] for record in records]),
            has_depth=has,
            metric=has & np.array(metres),
            state=np.stack([state_labels(record) for record in records]),
            task=tuple(record["task"] for record in records),
            **fields,
        )

    def first(self, frames: int) -> "Clips":
        """Returns the clips cut to their first frames."""
        whole = {name: getattr(self, name)[:, :frames] for name in ("rgb", "depth", "actions", "success", "state")}
        if self.second is not None:
            whole["second"] = self.second[:, :frames]
        return replace(self, tracks=self.tracks[:, :, :frames], visible=self.visible[:, :, :frames], **whole)

    @property
    def video(self) -> Video:
        """Frames and depth; NaN in clips without depth."""
        if not self.has_depth.any():
            return Video(self.rgb, None, np.array(self.task), self.state, self.second)
        return self._video(self.has_depth)

    @property
    def metric_video(self) -> Video:
        """Frames and depth in metres; NaN in clips without metric depth."""
        return self._video(self.metric)

    def _video(self, has_depth: Bool[np.ndarray, " B"]) -> Video:
        depth = np.where(has_depth[:, None, None, None], self.depth, np.float32(np.nan))
        return Video(self.rgb, depth, np.array(self.task), self.state, self.second)


def spread(source: Sized, count: int) -> list[int]:
    """Returns the numbers of ``count`` records spread evenly over a split, since neighbours may be of one episode."""
    return np.unique(np.linspace(0, len(source) - 1, min(count, len(source))).round().astype(int)).tolist()


def first_clip(store: Store) -> Record:
    """Returns the first readable record of a store's train split.

    Raises:
        StoreError: no record can be read.
    """
    for _, record in readable(store.source("train"), tell=lambda _: None):
        return record
    raise StoreError(f"{store.path}: no clip of its train split can be read; get it again")


def readable(
    source: RecordSource, numbers: Iterable[int] | None = None, tell: Callable[[str], None] = note
) -> Iterator[tuple[int, Record]]:
    """Yields the readable records of a split with their numbers, and reports the others, so that work continues.

    Args:
        numbers: numbers of the records to read; all if None.
        tell: called with a message about each record that cannot be read.
    """
    for number in range(len(source)) if numbers is None else numbers:
        try:
            record = source[number]
        except StoreError as error:
            tell(f"{error}; it is left out here")
            continue
        yield number, record


def load_clips(store: Store, count: int, split: str = "test") -> Clips:
    """Loads ``count`` clips spread over a split, except those that cannot be read.

    Raises:
        StoreError: no clip can be read.
    """
    source = store.source(split)
    records = list(readable(source, spread(source, count)))
    if not records:
        raise StoreError(f"{store.path}: its {split} split has no readable clip; delete it and make it again")
    return Clips.stacked([clip for _, clip in records], [number for number, _ in records])


def frame_rate(clip: Record, manifest: Mapping[str, Any]) -> float | None:
    """Returns the frames per second of a store's clips, from one of them; None if it is unknown or no number.

    Args:
        manifest: the store's manifest; for simulated clips it has the control steps between two frames.
    """
    origin = clip["provenance"]
    frames = origin.get("frames", ())
    fps = origin.get("fps")
    control = origin.get("control_hz")
    with suppress(TypeError, ValueError, ZeroDivisionError):  # anybody may write a provenance
        if fps and len(frames) > 1:
            return float(fps) * (len(frames) - 1) / (frames[-1] - frames[0])
        steps = (manifest.get("config") or {}).get("control_steps") or origin.get("control_steps")
        if control and steps:
            return float(control) / steps
    return None


def keeps_rate(clip: Record, manifest: Mapping[str, Any], fps: float) -> bool:
    """Returns whether a clip has ``fps``, up to two frames in its length: windows round to recorded frames."""
    return abs((frame_rate(clip, manifest) or 0.0) - fps) * (len(clip["rgb"]) - 1) <= 2 * fps
