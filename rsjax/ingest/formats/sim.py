"""The project's own simulators: a store of clips that ``rsjax.sim`` collected, each clip an episode.

A clip's actions, depth (where it is in metres) and task are taken as they are; its exact keypoint tracks stay in the
store, and ``meta["clip"]`` says where. Any other store of clips is read in the same way when it is checked.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, UInt8

from rsjax.data.store import Record, Store, StoreError, open_store
from rsjax.errors import did_you_mean
from rsjax.ingest.actions import Layout
from rsjax.ingest.episode import Episode, EpisodeError, EpisodeRef, SourceError, checked, fingerprint

FPS = 5.0  # of a clip that does not say how it was made
_CURE = "make the store again or leave the episode out"


def open_source(path: Path, split: str = "") -> "StoreSource":
    """A store of clips.

    Args:
        path: its directory.
        split: only this one; all if not given.

    Raises:
        SourceError: it is no whole store of clips, or has no such split.
    """
    try:
        store = open_store(path)
    except StoreError as error:
        raise SourceError(str(error)) from error
    if store.manifest.get("kind") != "clips":
        raise SourceError(f"{path}: a store of {store.manifest.get('kind')}; give one of clips")
    if split and split not in store.splits:
        raise SourceError(f"{path}: no split {split!r}{did_you_mean(split, store.splits)}; it has {list(store.splits)}")
    return StoreSource(store, (split,) if split else store.splits)


@dataclass(frozen=True)
class StoreSource:
    """See :class:`rsjax.ingest.episode.EpisodeSource`.

    Attributes:
        store: of clips.
        splits: those that are read.
    """

    name = "sim"
    store: Store
    splits: tuple[str, ...]

    def episodes(self) -> Iterator[EpisodeRef]:
        """Every clip of every split, in the store's order."""
        key = fingerprint((), self.store.manifest.get("key"), self.store.manifest["splits"])
        for split in self.splits:
            for number in range(len(self.store.source(split))):
                where = {"split": split, "record": number}
                yield EpisodeRef(f"{split}-{number:06d}", fingerprint((), key, split, number), where)

    def read(self, ref: EpisodeRef) -> Episode:
        """One clip."""
        split, number = ref.location["split"], ref.location["record"]
        try:
            source = self.store.source(split)
            record, place = source[number], source.locate(number)
        except (StoreError, IndexError) as error:
            raise EpisodeError(f"{self.store.path}: {split} record {number}: {error}") from error
        where = f"{self.store.path / place['file']}: {split} record {number}"
        try:
            _check_arrays(record, where)
            return checked(self._episode(ref, record, place), where)
        except (AttributeError, KeyError, TypeError, ValueError, ZeroDivisionError, OverflowError) as error:
            told = " ".join(str(error).split())[:200]
            raise EpisodeError(f"{where}: provenance or settings are wrong ({told}); {_CURE}") from error

    def _episode(self, ref: EpisodeRef, record: Record, place: dict[str, Any]) -> Episode:
        provenance = record.get("provenance", {})
        camera = str(provenance.get("camera", "camera"))
        fps, timestamps = self._times(provenance, len(record["rgb"]))
        measured = provenance.get("depth_unit", "metres") == "metres" and record.get("depth") is not None
        return Episode(
            id=ref.id,
            fingerprint=ref.fingerprint,
            task=str(record.get("task", "")),
            fps=fps,
            timestamps=timestamps,
            actions=record["actions"].astype(np.float32),
            states=None,
            cameras={camera: ArrayFrames(record["rgb"])},
            depth={camera: ArrayDepths(record["depth"])} if measured else {},
            meta={
                "source": self.store.manifest.get("source", "sim"),
                "clip": place,
                "provenance": provenance,
                "actions": Layout(held=self._grippers(provenance, record["actions"].shape[1])).to_json(),
                "success": np.asarray(record.get("success", []), bool).tolist(),
            },
        )

    def _control_steps(self) -> int:
        return int(self.store.manifest.get("config", {}).get("control_steps", 1))

    def _grippers(self, provenance: dict[str, Any], width: int) -> tuple[int, ...]:
        """The last dimension of each control step of a simulator; other clips do not say."""
        steps = self._control_steps()
        if "control_hz" not in provenance or width % steps:
            return ()
        return tuple(range(width // steps - 1, width, width // steps))

    def _times(self, provenance: dict[str, Any], count: int) -> tuple[float, Float[np.ndarray, " N"]]:
        """Frames per second, and when each frame was: by a simulator's clock, or by its number in the recording."""
        if "control_hz" in provenance:
            fps = float(provenance["control_hz"]) / self._control_steps()
        elif count > 1 and len(provenance.get("frames", ())) == count:
            times = (np.array(provenance["frames"]) - provenance["frames"][0]) / float(provenance["fps"])
            return 1 / max(float(np.median(np.diff(times))), 1e-6), times
        else:
            fps = FPS
        return fps, np.arange(count) / fps


class ArrayFrames:
    """Pictures in memory, as :class:`rsjax.ingest.episode.Frames`.

    Args:
        pictures: all of them.
    """

    def __init__(self, pictures: UInt8[np.ndarray, "N H W 3"]) -> None:
        self._pictures = pictures

    def __len__(self) -> int:
        return len(self._pictures)

    def read(self, indices: Sequence[int]) -> UInt8[np.ndarray, "n H W 3"]:
        """These pictures."""
        return self._pictures[np.asarray(indices, np.int64)]


class ArrayDepths:
    """Depth maps in memory, as :class:`rsjax.ingest.episode.Depths`.

    Args:
        maps: all of them, in metres.
    """

    def __init__(self, maps: Float32[np.ndarray, "N H W"]) -> None:
        self._maps = maps

    def __len__(self) -> int:
        return len(self._maps)

    def read(self, indices: Sequence[int]) -> Float32[np.ndarray, "n H W"]:
        """These maps."""
        return self._maps[np.asarray(indices, np.int64)].astype(np.float32)


def _check_arrays(record: Record, where: str) -> None:
    """Raises :class:`EpisodeError` where a clip's arrays are not such as a clip has."""
    if not np.isfinite(record.get("tracks", 0.0)).all():
        raise EpisodeError(f"{where}: tracks are not all finite; {_CURE}")
    wanted = {"rgb": (np.uint8, 4), "actions": (np.floating, 2)}
    if record.get("depth") is not None:
        wanted["depth"] = (np.floating, 3)
    for name, (kind, axes) in wanted.items():
        array = record.get(name)
        if not isinstance(array, np.ndarray) or not np.issubdtype(array.dtype, kind) or array.ndim != axes:
            found = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else type(array).__name__
            raise EpisodeError(f"{where}: {name} is {found}, should have {axes} axes of {kind.__name__}; {_CURE}")
    if record["rgb"].shape[3] != 3 or not record["rgb"].size:
        raise EpisodeError(f"{where}: rgb has the shape {record['rgb'].shape}, should be (T, H, W, 3); {_CURE}")
