"""Reads a store of clips that this project's simulators (``rsjax.tools.sim``) made; each clip is an episode.

A clip's actions, depth (if it is in metres) and task are taken unchanged; its exact keypoint tracks stay in the store,
and ``meta["clip"]`` says where. Any other store of clips is read in the same way for checks.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from rsjax.clip import UNKNOWN, words_of
from rsjax.data.state_labels import knows_success
from rsjax.data.store import Record, Source, Store, StoreError, open_store
from rsjax.errors import did_you_mean
from rsjax.tools.ingest.actions import ActionLayout, Kind, described_layout, layout_of
from rsjax.tools.ingest.episode import LEAVE_OUT, Episode, EpisodeError, EpisodeRef, SourceError, checked, fingerprint
from rsjax.tools.ingest.pictures import ArrayFrames

FPS = 5.0  # assumed for a clip that does not say how it was made
_CURE = f"make the store again or {LEAVE_OUT}"


def open_source(
    path: Path, split: str = "", kind: Kind | None = None, held: Sequence[int] | None = None
) -> "StoreSource":
    """Opens a store of clips.

    Args:
        path: the store's directory.
        split: the only split to read; "": all.
        kind: kind of the actions in clips that no simulator of this project made, in place of what the store says; see
            :class:`rsjax.tools.ingest.actions.ActionLayout`.
        held: dimensions of these actions that stay in force, such as a gripper's; None: not declared. If either is
            given, what the store says does not count.

    Raises:
        SourceError: ``path`` is not a complete store of clips, or has no such split.
    """
    try:
        store = open_store(path)
    except StoreError as error:
        raise SourceError(str(error)) from error
    if store.manifest.get("kind") != "clips":
        raise SourceError(f"{path}: a store of {store.manifest.get('kind')}; give one of clips")
    if split and split not in store.splits:
        raise SourceError(f"{path}: no split {split!r}{did_you_mean(split, store.splits)}; it has {list(store.splits)}")
    return StoreSource(store, (split,) if split else store.splits, kind, None if held is None else tuple(held))


@dataclass(frozen=True)
class StoreSource:
    """See :class:`rsjax.tools.ingest.episode.EpisodeSource`.

    Attributes:
        store: the store of clips.
        splits: the splits that are read.
        kind: kind of undeclared actions; see :func:`open_source`.
        held: likewise.
    """

    name = "sim"
    store: Store
    splits: tuple[str, ...]
    kind: Kind | None = None
    held: tuple[int, ...] | None = None

    @cached_property
    def origins(self) -> dict[str, list[str]]:
        """The episode of each clip, by split; the whole store is read for them, once."""
        sources = {split: self.store.source(split) for split in self.splits}
        return {split: [episode_of(source, each) for each in range(len(source))] for split, source in sources.items()}

    def episodes(self) -> Iterator[EpisodeRef]:
        """Lists every clip of every split, in the store's order. Clips of one episode are of one recording."""
        declared = (self.kind, self.held)
        key = fingerprint(
            (),
            self.store.manifest.get("key"),
            self.store.manifest["splits"],
            *([declared] if declared != (None, None) else []),
        )
        for split in self.splits:
            for number, episode in enumerate(self.origins[split]):
                location = {"split": split, "record": number}
                if episode:
                    location["recording"] = f"{split}-{episode}"
                yield EpisodeRef(f"{split}-{number:06d}", fingerprint((), key, split, number), location)

    def read(self, ref: EpisodeRef) -> Episode:
        """Reads one clip."""
        split = ref.location["split"]
        number = ref.location["record"]
        try:
            source = self.store.source(split)
            record = source[number]
            place = source.locate(number)
        except (StoreError, IndexError) as error:
            raise EpisodeError(f"{self.store.path}: {split} record {number}: {error}") from error
        where = f"{self.store.path / place['file']}: {split} record {number}"
        try:
            _check_arrays(record, where)
            return checked(self._episode(ref, record, place), where)
        except (AttributeError, KeyError, TypeError, ValueError, ZeroDivisionError, OverflowError) as error:
            detail = " ".join(str(error).split())[:200]
            raise EpisodeError.at(where, f"provenance or settings are wrong ({detail})", _CURE) from error

    def _episode(self, ref: EpisodeRef, record: Record, place: dict[str, Any]) -> Episode:
        provenance = record.get("provenance", {})
        camera = str(provenance.get("camera", "camera"))
        steps = int((self.store.manifest.get("config") or {}).get("control_steps", 1))
        count = len(record["rgb"])
        if "control_hz" in provenance:  # a simulator's clock
            fps = float(provenance["control_hz"]) / steps
            timestamps = np.arange(count) / fps
        elif count > 1 and len(provenance.get("frames", ())) == count:
            seconds = provenance.get("times") or np.array(provenance["frames"]) / float(provenance["fps"])
            timestamps = np.asarray(seconds, np.float64) - seconds[0]
            fps = 1 / max(float(np.median(np.diff(timestamps))), 1e-6)
        else:
            fps = FPS
            timestamps = np.arange(count) / fps
        width = record["actions"].shape[1]
        described = self.store.manifest.get("action_dimensions") or []
        layout = None
        if (self.kind, self.held) == (None, None) and len(described) == width:
            layout = described_layout(described)
        if layout is None:
            layout = layout_of(record["actions"], self.kind, self.held)
        if "control_hz" in provenance:  # a simulator's own: the last dimension of each control step is the gripper
            if width % steps == 0:
                last = width // steps - 1
            else:
                last = width
            layout = ActionLayout("delta", held=tuple(range(last, width, width // steps or 1)))
        measured = provenance.get("depth_unit", "metres") == "metres" and record.get("depth") is not None
        meta = {
            "source": self.store.manifest.get("source", "sim"),
            "clip": place,
            "provenance": provenance,
            "actions": layout.to_json(),
        }
        if knows_success(self.store):
            meta["success"] = np.asarray(record.get("success", []), bool).tolist()
        return Episode(
            id=ref.id,
            fingerprint=ref.fingerprint,
            task="" if record.get("task") == UNKNOWN else words_of(record.get("task")),
            fps=fps,
            timestamps=timestamps,
            actions=record["actions"].astype(np.float32),
            states=None,
            cameras={camera: ArrayFrames(record["rgb"])},
            depth={camera: ArrayFrames(record["depth"].astype(np.float32))} if measured else {},
            meta=meta,
        )


def episode_of(source: Source, number: int) -> str:
    """Returns the episode from which a clip was cut; "" if it does not say so, or cannot be read."""
    try:
        return str(source[number]["provenance"]["episode"])
    except (StoreError, KeyError, TypeError):  # refused when it is read
        return ""


def _check_arrays(record: Record, where: str) -> None:
    """Raises :class:`EpisodeError` if a record's arrays do not have the types and shapes of a clip."""
    if not np.isfinite(record.get("tracks", 0.0)).all():
        raise EpisodeError.at(where, "tracks are not all finite", _CURE)
    wanted = {"rgb": (np.uint8, 4), "actions": (np.floating, 2)}
    if record.get("depth") is not None:
        wanted["depth"] = (np.floating, 3)
    for name, (kind, axes) in wanted.items():
        array = record.get(name)
        if not isinstance(array, np.ndarray) or not np.issubdtype(array.dtype, kind) or array.ndim != axes:
            if isinstance(array, np.ndarray):
                actual = f"{array.dtype} {array.shape}"
            else:
                actual = type(array).__name__
            raise EpisodeError.at(where, f"{name} is {actual}, should have {axes} axes of {kind.__name__}", _CURE)
    if record["rgb"].shape[3] != 3 or not record["rgb"].size:
        raise EpisodeError.at(where, f"rgb has the shape {record['rgb'].shape}, should be (T, H, W, 3)", _CURE)
