"""Reads RLDS data sets in TFRecord files (Bridge and others of Open X-Embodiment), one episode per record.

A folder contains ``{name}-{split}.tfrecord-00000-of-NNNNN`` and ``features.json``. An episode is flattened:
``steps/observation/image_0`` is a list of T encoded pictures, ``steps/action`` is T·7 numbers one after the other. The
meaning of the features differs between data sets: a :class:`KeyMap` states it, and is checked against
``features.json``. In RLDS the action of a step was done *after* its observation.
"""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from rsjax.errors import did_you_mean
from rsjax.files import safe_id
from rsjax.progress import note
from rsjax.tools.ingest.actions import Kind, align_actions, check_layout, layout_of
from rsjax.tools.ingest.episode import (
    LEAVE_OUT,
    MAX_FPS,
    Depths,
    Episode,
    EpisodeError,
    EpisodeRef,
    SourceError,
    checked,
    runs,
)
from rsjax.tools.ingest.formats.files import broken, exists, near, read_json
from rsjax.tools.ingest.formats.keymap import MAPS, KeyMap, key_map
from rsjax.tools.ingest.formats.tfrecord import Example, read_record, record_refs
from rsjax.tools.ingest.pictures import ArrayFrames, EncodedFrames

_SHARD = re.compile(r"(?P<name>.+)-(?P<split>[^-]+)\.tfrecord-(?P<number>\d+)-of-(?P<shards>\d+)")
_TEXT = re.compile(r"instruction|language|task")
_STATE = re.compile(r"state|proprio|pose|position|joint|gripper|eef|effector")
_WIDEST = 64  # largest size of a state; more numbers are an embedding


def open_source(
    path: Path,
    keys: str = "",
    split: str = "",
    fps: float = 0.0,
    kind: Kind | None = None,
    held: Sequence[int] | None = None,
) -> "RldsSource":
    """Opens an RLDS data set.

    Args:
        path: the folder with the shards, one of its two parents (``name/1.0.0/``), or a single shard.
        keys: a named key map, the path of one as JSON (the fields of :class:`KeyMap`), or ``auto``: one proposed from
            ``features.json``, which is printed; "": the one for the data set's name.
        split: the only split to read; "": all.
        fps: steps per second, in place of the key map's; 0: the key map's.
        kind: kind of the actions, likewise; None: the key map's.
        held: likewise.

    Raises:
        SourceError: there are no shards, or the key map does not fit ``features.json``.
    """
    shards = [path]
    if not path.is_file():
        shards = sorted(near(path, "*.tfrecord*"))
        folders = sorted({shard.parent for shard in shards})
        if not folders:
            where = "no *.tfrecord* files here or two folders further down"
            raise SourceError(f"{path}: {where}; give the folder with them")
        if len(folders) > 1:
            several = ", ".join(map(str, folders[:4]))
            raise SourceError(f"{path}: several data sets ({several} …); give the folder of one")
    folder = shards[0].parent
    info = _read_object(folder / "dataset_info.json")
    if not 0 <= fps <= MAX_FPS:
        raise SourceError(f"rlds: option fps is {fps}; it must be above 0 and at most {MAX_FPS:g}")
    described = folder / "features.json"
    features = step_features(described, _read_object(described))
    if keys == "auto":
        keymap = propose(described, features, fps)
    else:
        keymap = key_map(keys, info.get("name") or _split_name(shards[0])[0], folder)
    keymap = replace(
        keymap,
        fps=fps or keymap.fps,
        kind=kind or keymap.kind,
        held=keymap.held if held is None else tuple(held),
    )
    if keys == "auto":
        cure = "mend what is wrong in it as a file of your own (--option keys=FILE.json)"
        note(f"{folder}: key map {json.dumps(keymap.to_json())}; {cure}")
    check_keys(keymap, described, features)
    shapes = {key: features[key].shape for key in keymap.depth.values() if key in features}
    sides = {key: shape[:2] for key, shape in shapes.items() if shape and len(shape) > 1}
    chosen = [shard.name for shard in shards if not split or _split_name(shard)[1] == split]
    if not chosen:
        splits = sorted({_split_name(shard)[1] for shard in shards})
        raise SourceError(f"{folder}: no split {split!r}{did_you_mean(split, splits)}; it has {', '.join(splits)}")
    return RldsSource(folder, tuple(chosen), keymap, path.is_file(), sides)


@dataclass(frozen=True)
class RldsSource:
    """See :class:`rsjax.tools.ingest.episode.EpisodeSource`.

    Attributes:
        folder: where the shards are.
        shards: the shards' file names, in order.
        keys: the meaning of the features.
        single: whether the user named one shard, not a folder, so that no other shards are missing.
        sides: height and width of depth maps, by feature.
    """

    name = "rlds"
    folder: Path
    shards: tuple[str, ...]
    keys: KeyMap
    single: bool = False
    sides: Mapping[str, tuple[int, ...]] = field(default_factory=dict)

    def episodes(self) -> Iterator[EpisodeRef]:
        """Lists every record of every shard; one unreadable entry stands for all that a damaged shard lacks."""
        expected: dict[str, int] = {}  # how many records each shard should have, as far as dataset_info.json says
        path = self.folder / "dataset_info.json"
        info = _read_object(path)
        try:
            for split in info.get("splits", []):
                lengths = split.get("shardLengths", [])
                for number, length in enumerate(lengths):
                    name = f"{info.get('name')}-{split.get('name')}.tfrecord-{number:05d}-of-{len(lengths):05d}"
                    expected[name] = int(length)
        except (AttributeError, TypeError, ValueError) as error:
            raise SourceError(f"{path}: splits are not such as TFDS writes ({error}); fetch it again") from error
        for shard in self.shards:
            match = _SHARD.fullmatch(shard)
            if match:
                stem = f"{match['split']}-{int(match['number']):05d}"
            else:
                stem = safe_id(shard)
            counts = expected.get(shard, 0), "dataset_info.json names"
            settings = {n: v for n, v in asdict(self.keys).items() if self.keys.depth or not n.startswith("depth")}
            if not self.keys.angles:  # so that the fingerprints of data sets without angles stay as they were
                del settings["angles"]
            yield from record_refs(self.folder, shard, f"{stem}-{{:05d}}", counts, settings)
        if self.single:
            return
        numbers: dict[tuple[str, str, int], set[int]] = {}  # of the shards of each split
        for match in filter(None, map(_SHARD.fullmatch, self.shards)):
            numbers.setdefault((match["name"], match["split"], int(match["shards"])), set()).add(int(match["number"]))
        for (_, split, total), present in numbers.items():
            if missing := total - len(present):
                first = next(number for number in range(total) if number not in present)
                problem = f"{missing} of the {total} shards of {split} are missing, the first is {first:05d}"
                message = f"{self.folder}: {problem}; fetch them or give one shard alone"
                yield broken(safe_id(f"{split}-missing"), message)

    def read(self, ref: EpisodeRef) -> Episode:
        """Reads one record. Cameras with a placeholder of one colour are left out; ``meta["blank"]`` names them."""
        example = read_record(self.folder, ref)
        frames = {
            name: EncodedFrames(example.blobs(f"steps/{key}"), f"{example.where}: steps/{key}")
            for name, key in self.keys.cameras.items()
        }
        # BridgeData has flags for placeholders (``has_image_0``), but files exist in which all flags are false.
        blank = [
            name
            for name, pictures in frames.items()
            if len(set(pictures.payloads)) == 1 and not np.ptp(pictures.read([0]), axis=(0, 1, 2)).any()
        ]
        cameras = {name: pictures for name, pictures in frames.items() if name not in blank}
        if not cameras:
            raise EpisodeError.at(example.where, f"{', '.join(blank)} hold placeholders of one colour", LEAVE_OUT)
        count = len(next(iter(cameras.values())))
        keys = self.keys
        rows, names = _joined(example, keys.action, count)
        actions = align_actions(rows, keys.after)
        states = None
        if keys.state:
            states = _joined(example, keys.state, count)[0]
        layout = layout_of(actions, keys.kind, keys.held, keys.quaternions, keys.angles, names, states)
        check_layout(layout, actions.shape[1], f"{example.where}: key map")
        texts = _texts(example, self.keys.task, count)
        segments = [segment for segment in runs(texts) if segment.text]
        metadata = {}
        for name in example.names():
            if name.startswith("episode_metadata/") and len(value := example.plain(name)) == 1:
                metadata[name.removeprefix("episode_metadata/")] = value[0]
        episode = Episode(
            id=ref.id,
            fingerprint=ref.fingerprint,
            task=next((text for text in texts if text), ""),
            fps=self.keys.fps,
            timestamps=np.arange(count) / self.keys.fps,
            actions=actions,
            states=states,
            cameras=cameras,
            depth={name: self._depth(example, key) for name, key in self.keys.depth.items() if name in cameras},
            segments=tuple(segments) if len({segment.text for segment in segments}) > 1 else (),
            meta={
                "source": "rlds",
                "file": ref.location["file"],
                "actions": layout.to_json(),
                "action_names": names,
                "blank": blank,
                "episode": metadata,
            },
        )
        return checked(episode, example.where)

    def _depth(self, example: Example, key: str) -> Depths:
        """Returns the depth maps of a feature: encoded pictures, or numbers one after the other."""
        name = f"steps/{key}"
        scale = self.keys.depth_scale
        if example.is_bytes(name):
            return EncodedFrames(example.blobs(name), f"{example.where}: {name}", scale)
        height, width = self.sides.get(key, (0, 0))
        if height <= 0 or width <= 0:
            raise EpisodeError.at(example.where, f"{name} is of numbers, and features.json has no shape", LEAVE_OUT)
        values, floats = example.flat(name)
        if values.size % (height * width):
            raise EpisodeError.at(example.where, f"{name} has {values.size} values, maps have {height} × {width}")
        maps = values.reshape(-1, height, width) * np.float32(1 if floats else scale)
        return ArrayFrames(np.nan_to_num(maps, nan=0, posinf=0, neginf=0))


def _joined(example: Example, keys: Sequence[str], count: int) -> tuple[Float32[np.ndarray, "N n"], list[str]]:
    """Returns these features side by side, and a name for each dimension."""
    parts = [example.numbers(f"steps/{key}", count) for key in keys]
    widths = [part.shape[1] for part in parts]
    names = [f"{key}[{n}]" if width > 1 else key for key, width in zip(keys, widths, strict=True) for n in range(width)]
    return np.concatenate(parts, axis=1), names


def _texts(example: Example, keys: Sequence[str], count: int) -> list[str]:
    """Returns the text of each step, from the first of these features that is not empty."""
    for key in (f"steps/{key}" for key in keys if f"steps/{key}" in example):
        if example.is_bytes(key):
            rows = example.blobs(key)
        else:  # each text is a row of numbers, padded with zeros
            codes = np.nan_to_num(example.numbers(key, count))
            rows = [bytes(int(code) & 0xFF for code in row if code) for row in codes]
        texts = [row.decode("utf-8", "replace").strip() for row in rows]
        if any(texts):
            return texts
    return []


def _split_name(shard: Path) -> tuple[str, str]:
    """Returns the names of the data set and of the split in a shard's name."""
    match = _SHARD.fullmatch(shard.name)
    if match:
        return (match["name"], match["split"])
    return (shard.name.partition(".")[0], "")


def _read_object(path: Path) -> dict[str, Any]:
    """Reads a JSON object; an empty one if there is no file."""
    if exists(path):
        content = read_json(path)
    else:
        content = {}
    if not isinstance(content, dict):
        raise SourceError(f"{path}: is a {type(content).__name__}, should be an object; fetch it again")
    return content


@dataclass(frozen=True)
class Feature:
    """A feature of a step.

    Attributes:
        kind: ``image``, ``text``, ``tensor`` or ``other``.
        shape: shape of a step's value, -1 for an open length; None if the file does not say.
        dtype: such as ``uint8``, "" if the file does not say.
    """

    kind: str
    shape: tuple[int, ...] | None = None
    dtype: str = ""

    @property
    def is_row(self) -> bool:
        """Returns whether it is one or a few floats."""
        few = self.shape is None or (len(self.shape) <= 1 and (self.shape or (1,))[0] <= _WIDEST)
        return self.kind == "tensor" and few and self.dtype in ("", "float32", "float64")

    @property
    def is_map(self) -> bool:
        """Returns whether it has one channel, as depth maps have."""
        if self.kind == "image":
            return self.shape is not None and self.shape[2:] == (1,)
        return (
            self.kind == "tensor" and self.shape is not None and len(self.shape) in (2, 3) and min(self.shape[:2]) > 7
        )


def step_features(path: Path, content: Mapping[str, Any]) -> dict[str, Feature]:
    """Returns the features of a step by their keys below ``steps/``; none if the file is empty.

    Args:
        path: path of ``features.json``, for error messages.
        content: content of the file.

    Raises:
        SourceError: the content is not in the form that TFDS writes.
    """
    try:
        steps = content.get("featuresDict", {}).get("features", {}).get("steps", {})
        return _features(steps.get("sequence", {}).get("feature", {}))
    except (AttributeError, TypeError, ValueError) as error:
        raise SourceError(f"{path}: not such as TFDS writes ({error}); fetch it again") from error


def _features(tree: Mapping[str, Any], prefix: str = "") -> dict[str, Feature]:
    features: dict[str, Feature] = {}
    for name, child in tree.get("featuresDict", {}).get("features", {}).items():
        if "featuresDict" in child:
            features |= _features(child, f"{prefix}{name}/")
            continue
        kind = next((kind for kind in ("image", "text", "tensor") if kind in child), "other")
        values = child.get(kind, {})
        shape = None
        if "shape" in values:
            shape = tuple(int(side) for side in values["shape"].get("dimensions", ()))
        features[f"{prefix}{name}"] = Feature(kind, shape, str(values.get("dtype", "")))
    return features


def propose(path: Path, features: Mapping[str, Feature], fps: float) -> KeyMap:
    """Returns a key map by the features' names, kinds and shapes; these do not say what the actions' numbers mean.

    Args:
        path: path of ``features.json``, for error messages.
        features: the features of a step.
        fps: steps per second, which no file states.

    Raises:
        SourceError: there are no pictures or no actions, or ``fps`` is 0.
    """
    maps = {_name(key): key for key, feature in features.items() if feature.is_map and "depth" in key}
    pictures = [key for key, feature in features.items() if feature.kind == "image" and key not in maps.values()]
    cameras = {_name(key): key for key in sorted(pictures) if not features[key].is_map}
    whole = features.get("action")
    if whole and whole.is_row:
        action = ["action"]
    else:
        action = [key for key, one in features.items() if one.is_row and key.startswith(("action/", "action_"))]
    if not cameras or not action:
        lacks = "actions"
        if not cameras:
            lacks = "pictures"
        raise SourceError(f"{path}: no {lacks} among {', '.join(features) or 'no features'}; write a key map as JSON")
    if not fps:
        raise SourceError(f"{path}: no file of RLDS says how fast its pictures are; add --option fps=…")
    observed = [key for key, one in features.items() if key.startswith("observation/") and one.is_row]
    own = [key for key in observed if key == "observation/state"]
    texts = [key for key, one in features.items() if one.kind == "text" and _TEXT.search(key)]

    def bare(name: str) -> str:
        return "_".join(word for word in name.split("_") if word not in ("depth", "image", "rgb", "color"))

    # A single camera has the only maps; otherwise the names must match without words such as "depth" and "rgb".
    if len(cameras) == len(maps) == 1:
        depth = dict(zip(cameras, maps.values(), strict=True))
    else:
        by_name = {bare(name): key for name, key in maps.items()}
        depth = {name: by_name[bare(name)] for name in cameras if bare(name) in by_name}
    return KeyMap(
        cameras=cameras,
        action=tuple(action),
        fps=fps,
        state=tuple(own or [key for key in observed if _STATE.search(key)]),
        task=tuple(sorted(texts, key=len)),
        kind=None,
        held=None,
        depth=depth,
    )


def _name(key: str) -> str:
    return key.removeprefix("observation/").replace("/", "_")


def check_keys(keys: KeyMap, path: Path, features: Mapping[str, Feature]) -> None:
    """Checks that a data set has each feature of a map.

    Args:
        path: path of ``features.json``, for error messages.
        features: the features of a step; nothing is checked if there are none.

    Raises:
        SourceError: a feature is missing or of another kind.
    """
    wanted: list[tuple[str, tuple[str, ...]]] = [(key, ("image",)) for key in keys.cameras.values()]
    wanted += [(key, ("tensor",)) for key in (*keys.action, *keys.state)]
    wanted += [(key, ("image", "tensor")) for key in keys.depth.values()]
    for key, kinds in wanted if features else ():
        if key not in features:
            hint = did_you_mean(key, features) or f"; steps have {', '.join(sorted(features))}"
            raise SourceError(f"{path}: no steps/{key}, which the key map names{hint}. Maps: {', '.join(MAPS)}")
        if features[key].kind not in kinds:
            says = f"steps/{key} is of kind {features[key].kind}, the key map says {' or '.join(kinds)}"
            raise SourceError(f"{path}: {says}; mend the map")
