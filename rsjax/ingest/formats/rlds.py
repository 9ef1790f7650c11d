"""RLDS data sets in TFRecord files (Bridge and others of Open X-Embodiment), one episode a record.

A folder holds ``{name}-{split}.tfrecord-00000-of-NNNNN`` and ``features.json``. An episode is flattened:
``steps/observation/image_0`` is a list of T encoded pictures, ``steps/action`` T·7 numbers one after the other. Which
feature is what differs from data set to data set: a :class:`KeyMap` says it, and ``features.json`` is asked whether it
can be true. In RLDS the action of a step is what was done *after* its observation.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, UInt8

from rsjax.errors import did_you_mean
from rsjax.ingest.actions import Layout, check_layout, led_into
from rsjax.ingest.episode import (
    Episode,
    EpisodeError,
    EpisodeRef,
    Segment,
    SourceError,
    checked,
    fingerprint,
    safe_id,
)
from rsjax.ingest.formats.files import broken, location_of
from rsjax.ingest.formats.keymap import KeyMap, check_keys, key_map, read_json
from rsjax.ingest.formats.tfrecord import Example, Span, read_payload, spans
from rsjax.ingest.pictures import decode_picture

_SHARD = re.compile(r"(?P<name>.+)-(?P<split>[^-]+)\.tfrecord-(?P<number>\d+)-of-(?P<shards>\d+)")
_CURE = "fetch the file again or leave the episode out"


def open_source(path: Path, keys: str = "", split: str = "") -> "RldsSource":
    """An RLDS data set.

    Args:
        path: the folder with the shards, one of its two parents (``name/1.0.0/``), or a single shard.
        keys: a named key map, or the path of one as JSON (the fields of :class:`KeyMap`). Not given: the one that goes
            with the data set's name.
        split: only this one; all if not given.

    Raises:
        SourceError: there are no shards, or the key map does not go with ``features.json``.
    """
    shards = _shards(path)
    folder = shards[0].parent
    name = read_json(folder / "dataset_info.json").get("name") or _split_name(shards[0])[0]
    keymap = key_map(keys, name, folder)
    check_keys(keymap, folder)
    chosen = [shard for shard in shards if not split or _split_name(shard)[1] == split]
    if not chosen:
        have = sorted({_split_name(shard)[1] for shard in shards})
        raise SourceError(f"{folder}: no split {split!r}{did_you_mean(split, have)}; it has {', '.join(have)}")
    return RldsSource(folder, tuple(shard.name for shard in chosen), keymap, path.is_file())


@dataclass(frozen=True)
class RldsSource:
    """See :class:`rsjax.ingest.episode.EpisodeSource`.

    Attributes:
        folder: where the shards are.
        shards: their file names, in order.
        keys: which feature is what.
        single: whether it is one shard that was asked for, not all there are.
    """

    name = "rlds"
    folder: Path
    shards: tuple[str, ...]
    keys: KeyMap
    single: bool = False

    def episodes(self) -> Iterator[EpisodeRef]:
        """From the heads of the records alone. What a damaged shard lacks is one entry, which ``read`` refuses."""
        promised = _promised(self.folder)
        for shard in self.shards:
            found = list(spans(self.folder / shard))
            if len(found) < promised.get(shard, 0) and not (found and found[-1].damage):
                end = f"holds {len(found)} of the {promised[shard]} records that dataset_info.json names"
                found.append(Span(0, 0, damage=end))
            for number, span in enumerate(found):
                where = {"file": shard, "offset": span.offset, "length": span.length, "damage": span.damage}
                marks = fingerprint((), shard, span.length, span.crc, span.damage, asdict(self.keys))
                yield EpisodeRef(f"{_stem(shard)}-{number:05d}", marks, where)
        for split, told in self._lacking():
            yield broken(safe_id(f"{split}-missing"), told)

    def _lacking(self) -> Iterator[tuple[str, str]]:
        """Splits of which shards are missing by the names of the others. A user who asks for one shard lacks none."""
        there: dict[tuple[str, str, int], set[int]] = {}
        for match in filter(None, map(_SHARD.fullmatch, self.shards)):
            there.setdefault((match["name"], match["split"], int(match["shards"])), set()).add(int(match["number"]))
        for (_, split, total), numbers in there.items() if not self.single else ():
            if gone := total - len(numbers):
                first = next(number for number in range(total) if number not in numbers)
                told = f"{gone} of the {total} shards of {split} are missing, the first is {first:05d}"
                yield split, f"{self.folder}: {told}; fetch them or give one shard alone"

    def read(self, ref: EpisodeRef) -> Episode:
        """One record. Cameras that hold a placeholder of one colour are left out, ``meta["blank"]`` names them."""
        path = _inside(self.folder, location_of(ref)["file"])
        if ref.location["damage"]:
            raise EpisodeError(f"{path}: {ref.location['damage']}; {_CURE}")
        where = f"{path}: record {ref.id}"
        example = Example(read_payload(path, ref.location["offset"], ref.location["length"]), where)
        cameras, blank = _cameras(example, self.keys)
        if not cameras:
            raise EpisodeError(f"{where}: {', '.join(blank)} hold placeholders of one colour; leave the episode out")
        count = len(next(iter(cameras.values())))
        actions = _joined(example, self.keys.action, count)
        layout = Layout(self.keys.kind, self.keys.quaternions, self.keys.held)
        check_layout(layout, actions.shape[1], f"{where}: key map")
        texts = _texts(example, self.keys.task, count)
        episode = Episode(
            id=ref.id,
            fingerprint=ref.fingerprint,
            task=next((text for text in texts if text), ""),
            fps=self.keys.fps,
            timestamps=np.arange(count) / self.keys.fps,
            actions=_aligned(actions, self.keys.after),
            states=_joined(example, self.keys.state, count) if self.keys.state else None,
            cameras=cameras,
            segments=_segments(texts),
            meta={
                "source": "rlds",
                "file": path.name,
                "actions": layout.to_json(),
                "blank": blank,
                "episode": _metadata(example),
            },
        )
        return checked(episode, where)


class EncodedFrames:
    """Encoded pictures in memory, as :class:`rsjax.ingest.episode.Frames`.

    Args:
        payloads: each frame's PNG or JPEG.
        where: the file and feature that messages name.
    """

    def __init__(self, payloads: Sequence[bytes], where: str) -> None:
        self._payloads, self._where = list(payloads), where

    def __len__(self) -> int:
        return len(self._payloads)

    def read(self, indices: Sequence[int]) -> UInt8[np.ndarray, "n H W 3"]:
        """These pictures.

        Raises:
            EpisodeError: one is damaged or of another size than the first.
        """
        pictures = [decode_picture(self._payloads[i], f"{self._where} frame {i}") for i in indices]
        for index, picture in zip(indices, pictures, strict=True):
            if picture.shape != pictures[0].shape:
                sizes = f"{picture.shape[1]} × {picture.shape[0]}, frame {indices[0]} {pictures[0].shape[1::-1]}"
                raise EpisodeError(f"{self._where} frame {index}: pictures of several sizes ({sizes}); {_CURE}")
        return np.stack(pictures)

    def blank(self) -> bool:
        """Whether all are the same picture of one colour: what is stored where there was no such camera."""
        return (
            bool(self._payloads) and len(set(self._payloads)) == 1 and not np.ptp(self.read([0]), axis=(0, 1, 2)).any()
        )


def _cameras(example: Example, keys: KeyMap) -> tuple[dict[str, EncodedFrames], list[str]]:
    """Cameras by name, and the names of the placeholders.

    BridgeData has flags for this (``has_image_0``), but files exist in which they are all false.
    """
    frames = {
        name: EncodedFrames(example.blobs(f"steps/{key}"), f"{example.where}: steps/{key}")
        for name, key in keys.cameras.items()
    }
    blank = [name for name, pictures in frames.items() if pictures.blank()]
    return {name: pictures for name, pictures in frames.items() if name not in blank}, blank


def _joined(example: Example, keys: Sequence[str], count: int) -> Float32[np.ndarray, "N n"]:
    return np.concatenate([example.numbers(f"steps/{key}", count) for key in keys], axis=1)


def _aligned(actions: Float32[np.ndarray, "N A"], after: bool) -> Float32[np.ndarray, "N A"]:
    if not after:
        return led_into(actions)
    return np.concatenate([np.zeros_like(actions[:1]), actions[1:]])


def _texts(example: Example, keys: Sequence[str], count: int) -> list[str]:
    """What is said at each step: the first of these features that says anything."""
    for key in (f"steps/{key}" for key in keys):
        if key not in example:
            continue
        rows = example.blobs(key) if example.holds_bytes(key) else _characters(example.numbers(key, count))
        texts = [row.decode("utf-8", "replace").strip() for row in rows]
        if any(texts):
            return texts
    return []


def _characters(codes: Float32[np.ndarray, "N n"]) -> list[bytes]:
    """Text that is stored as a row of numbers, filled up with zeros."""
    return [bytes(int(code) & 0xFF for code in row if code) for row in np.nan_to_num(codes)]


def _segments(texts: list[str]) -> tuple[Segment, ...]:
    """Where the text changes on the way, its parts; an episode of one text has none."""
    segments, start = [], 0
    for text, run in groupby(texts):
        end = start + len(list(run))
        if text:
            segments.append(Segment(start, end, text))
        start = end
    return tuple(segments) if len({segment.text for segment in segments}) > 1 else ()


def _metadata(example: Example) -> dict[str, Any]:
    """The features of the episode itself that are a single text or number."""
    prefix, values = "episode_metadata/", {}
    for name in example.names():
        if name.startswith(prefix) and len(value := example.plain(name)) == 1:
            values[name.removeprefix(prefix)] = value[0]
    return values


def _shards(path: Path) -> list[Path]:
    """The shards at a path, all of one folder."""
    if path.is_file():
        return [path]
    found = [shard for depth in ("", "*/", "*/*/") for shard in path.glob(f"{depth}*.tfrecord*") if shard.is_file()]
    folders = sorted({shard.parent for shard in found})
    if not folders:
        raise SourceError(f"{path}: no *.tfrecord* files here or two folders further down; give the folder with them")
    if len(folders) > 1:
        raise SourceError(f"{path}: several data sets ({', '.join(map(str, folders[:4]))} …); give the folder of one")
    return sorted(found)


def _split_name(shard: Path) -> tuple[str, str]:
    """The names of the data set and of the split in a shard's."""
    match = _SHARD.fullmatch(shard.name)
    return (match["name"], match["split"]) if match else (shard.name.partition(".")[0], "")


def _stem(shard: str) -> str:
    match = _SHARD.fullmatch(shard)
    return f"{match['split']}-{int(match['number']):05d}" if match else safe_id(shard)


def _promised(folder: Path) -> dict[str, int]:
    """How many records each shard should have, as far as dataset_info.json says."""
    counts: dict[str, int] = {}
    path = folder / "dataset_info.json"
    info = read_json(path)
    try:
        for split in info.get("splits", []):
            lengths = split.get("shardLengths", [])
            for number, length in enumerate(lengths):
                name = f"{info.get('name')}-{split.get('name')}.tfrecord-{number:05d}-of-{len(lengths):05d}"
                counts[name] = int(length)
    except (AttributeError, TypeError, ValueError) as error:
        raise SourceError(f"{path}: splits are not such as TFDS writes ({error}); fetch it again") from error
    return counts


def _inside(folder: Path, name: str) -> Path:
    if Path(name).name != name:
        raise EpisodeError(f"{folder}: file {name!r} of an episode is not the name of a file in it; list it again")
    return folder / name
