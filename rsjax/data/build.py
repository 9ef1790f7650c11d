"""Makes a store from clips in memory, for data that no reader of :mod:`rsjax.tools.ingest` knows.

Axes: T frames, S×S pixels, A action dimensions, N₀ tracks.
"""

import contextlib
import dataclasses
import hashlib
import json
import math
import tempfile
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from array_record.python.array_record_module import ArrayRecordWriter
from jaxtyping import Bool

from rsjax.clip import GENERATED, UNKNOWN, Clip, words_of
from rsjax.data.codec import Record, encode
from rsjax.data.normalization import Statistics
from rsjax.data.store import MANIFEST, WRITER_OPTIONS, Source, Store, StoreError, encode_clip, open_store, write_store
from rsjax.errors import did_you_mean
from rsjax.files import checked_path, disk_guard, making

MOST_FPS = 10_000.0  # more is a mistake, not a camera
TRACKS = 256  # number of empty tracks of a clip without tracks
_LABELS = ("difficulty", "scene", "segment", "skill")
_ONE_VIEW = [field.name for field in dataclasses.fields(Clip) if field.name != "second"]
_FIELDS = (*_ONE_VIEW, "episode", "fps", *_LABELS)


@dataclasses.dataclass
class _Episode:
    """The manifest's record of the clips of one episode."""

    numbers: list[int] = dataclasses.field(default_factory=list)
    statistics: Statistics | None = None
    depth: list[float] = dataclasses.field(default_factory=list)
    successes: int = 0

    def add(self, record: Record, number: int) -> None:
        """Adds a clip."""
        rows = Statistics.of(record["actions"][1:])
        self.statistics = self.statistics.merged(rows) if self.statistics else rows
        self.numbers.append(number)
        self.successes += bool(record["success"][-1])
        if record["depth"] is not None:
            self.depth += [float(record["depth"].min()), float(record["depth"].max())]
            self.depth = [min(self.depth), max(self.depth)]


def write_clips(
    path: Path | str, clips: Iterable[Mapping[str, Any] | Clip], test_share: float = 0.1, generated: bool = False
) -> Store:
    """Writes a store of clips, as :func:`rsjax.write_store` documents it."""
    path = checked_path(path, "path")
    try:
        str(path).encode()
    except UnicodeEncodeError as error:
        raise StoreError(f"path is {str(path)!r:.80}; the files of a store need a path of text") from error
    if not isinstance(test_share, int | float) or not 0 <= test_share < 1:
        raise StoreError(f"test_share is {test_share!r:.80}; it is a share of the episodes, from 0 to below 1")
    if path.exists() and not (path / MANIFEST).exists():
        raise StoreError(f"{path}: exists and is not a store; move it away or choose another place")
    episodes: dict[str, _Episode] = {}
    try:
        given_clips = iter(clips)
    except TypeError as error:
        raise StoreError(f"clips are {clips!r:.80}; give an iterable of clips") from error
    first: dict[str, tuple[int, ...]] = {}
    digest = hashlib.sha256()
    scored = False
    with disk_guard(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent, prefix=f"{path.name}.") as folder:
        spool = Path(folder) / "clips.array_record"
        writer = ArrayRecordWriter(str(spool), WRITER_OPTIONS)
        count = 0
        for clip in given_clips:
            given = clip
            if isinstance(clip, Clip):
                given = encode_clip(clip)
            if not isinstance(given, Mapping):
                raise StoreError(f"clip {count}: is a {type(given).__name__}, should be a dict with rgb and actions")
            record = _record(given, f"clip {count}", count)
            if generated:
                record["provenance"]["source"] = GENERATED
            shapes = {name: array.shape for name, array in record.items() if isinstance(array, np.ndarray)}
            for name, shape in shapes.items():
                if name != "depth" and first.setdefault(name, shape) != shape:
                    hint = ""
                    if name == "tracks":
                        hint = f"; without tracks a clip gets {TRACKS} that are never visible"
                    raise StoreError(
                        f"clip {count}: {name} has the shape {shape}, that of the first clip {first[name]}{hint}"
                    )
            episodes.setdefault(record["provenance"]["episode"], _Episode()).add(record, count)
            labelled = given.get("success") is not None
            if count and labelled != scored:
                raise StoreError(
                    f"clip {count}: success is given for some clips and not for others; give it for all, or for none"
                )
            scored = labelled
            payload = encode(record)
            digest.update(payload)
            with disk_guard(path):  # errors from reading the clips stay the caller's
                writer.write(payload)
            count += 1
        with disk_guard(path):
            writer.close()
        if not count:
            raise StoreError(f"{path}: there are no clips to write")
        spooled = Source(Path(folder), "clips", [(spool.name, count)])
        with making(path, wait=True):
            _write(path, spooled, episodes, test_share, digest, scored)
    return open_store(path)


def choose_test(names: Collection[str], share: float, seed: int = 0) -> set[str]:
    """Chooses the names of the test split by a hash of each name, and of the seed unless it is 0.

    With a share above 0, each split gets at least one of two or more names; with 0 the test split is empty.
    """
    salt = str(seed or "")
    ranked = sorted(names, key=lambda name: hashlib.sha256((name + salt).encode("utf-8", "surrogatepass")).digest())
    if share <= 0:
        return set()
    return set(ranked[: min(len(ranked) - 1, max(1, round(share * len(ranked))))])


def _write(path: Path, spooled: Source, episodes: dict[str, _Episode], share: float, digest: Any, scored: bool) -> None:
    test = choose_test(episodes, share)
    names = {split: [name for name in episodes if (name in test) == (split == "test")] for split in ("train", "test")}
    total: Statistics | None = None
    for name in names["train"]:
        rows = episodes[name].statistics
        total = total.merged(rows) if total and rows else rows
    near_far = [value for name in names["train"] for value in episodes[name].depth]
    depth_range = None
    depth_unit = None
    if near_far:
        depth_range = [min(near_far), max(near_far)]
        depth_unit = "metres"
    success_share = None
    if scored:
        success_share = sum(episode.successes for episode in episodes.values()) / len(spooled)
    statistics = {}
    if total is not None:
        statistics = total.to_json()
    meta = {
        "key": f"{digest.hexdigest()[:12]}-{share}",
        "source": "write_store",
        **statistics,
        "depth_range": depth_range,
        "depth_unit": depth_unit,
        "episodes": names,
        "success_share": success_share,
    }
    splits = {
        split: (
            record | {"provenance": record["provenance"] | {"depth_range": depth_range}}
            for name in chosen
            for record in map(spooled.__getitem__, episodes[name].numbers)
        )
        for split, chosen in names.items()
    }
    write_store(path, "clips", splits, meta, clip_labels)


def clip_labels(record: Record) -> dict[str, str]:
    """Returns a clip's labels, by which a curriculum or a split can choose it."""
    return {"task": record["task"]} | {name: record["provenance"][name] or UNKNOWN for name in _LABELS}


def _record(clip: Mapping[str, Any], where: str, number: int) -> Record:
    """Returns a clip as a record of the store; :class:`StoreError` names a field that is missing or wrong."""
    for name in clip:
        if name not in _FIELDS:
            raise StoreError(f"{where}: no field {name!r}{did_you_mean(name, _FIELDS)}; it has {', '.join(_FIELDS)}")
    rgb = _array(clip, "rgb", where, "uint8 (T, S, S, 3)", np.uint8, (None, None, None, 3))
    count, size = rgb.shape[:2]
    if count < 2 or size < 8 or rgb.shape[2] != size:
        wrong = f"{count} frames of {rgb.shape[2]} × {size} pixels"
        raise StoreError(f"{where}: rgb has {wrong}; give two frames at least, cut or scaled to a square")
    actions = _array(clip, "actions", where, f"numbers ({count}, A)", np.float32, (count, None))
    if actions[0].any():
        cure = "shift them by a frame, or set row 0 to zeros if it is what led into frame 0"
        raise StoreError(
            f"{where}: row 0 of actions is not zeros; row t is what led from frame t-1 into frame t: {cure}"
        )
    depth = None
    origin = {"source": "write_store", "episode": number} | _provenance(clip, where)
    depth_unit = ""
    if clip.get("depth") is not None:
        known = origin.get("depth_unit") or "metres"
        if known != "metres":
            raise StoreError(f"{where}: its provenance says that depth is {known}, not in metres; leave depth out")
        depth_unit = "metres"
        depth = _array(clip, "depth", where, f"metres ({count}, {size}, {size})", np.float32, (count, size, size))
        if depth.min() <= 0:
            raise StoreError(f"{where}: depth is {depth.min():g} somewhere; it is in metres, above 0: fill its holes")
    tracks = np.zeros((TRACKS, count, 2), np.float32)
    visible = np.zeros((TRACKS, count), bool)
    if clip.get("tracks") is not None:
        tracks = _array(clip, "tracks", where, f"numbers (N, {count}, 2)", np.float32, (None, count, 2))
        visible = _array(clip, "visible", where, f"bool {tracks.shape[:2]}", np.bool_, tracks.shape[:2])
    words = {name: _text(clip, name, where) or words_of(origin.get(name)) or UNKNOWN for name in _LABELS}
    timing: dict[str, Any] = {}
    if clip.get("fps") is not None:
        try:
            rate = float(clip["fps"])
        except (TypeError, ValueError, OverflowError):
            rate = math.nan
        if isinstance(clip["fps"], bool) or not 0 < rate <= MOST_FPS:
            raise StoreError(
                f"{where}: fps is {clip['fps']!r:.80}; it is frames per second, above 0 and at most {MOST_FPS:g}: "
                f"leave it out if unknown"
            )
        timing = {"fps": rate, "frames": list(range(count))}
    return {
        "rgb": rgb,
        "depth": depth,
        "actions": actions,
        "tracks": tracks,
        "visible": visible,
        "success": _success(clip, where, count),
        "task": _text(clip, "task", where) or UNKNOWN,
        "provenance": origin
        | words
        | timing
        | {"depth_unit": depth_unit, "episode": _name(clip, where) or str(origin["episode"])},
    }


def _text(clip: Mapping[str, Any], name: str, where: str) -> str:
    """Returns a field of words; "" if it is missing, None or NaN, as pandas writes a missing text."""
    value = clip.get(name)
    if value is None or isinstance(value, str) or (isinstance(value, float) and math.isnan(value)):
        return words_of(value)
    raise StoreError(f"{where}: {name} is {value!r:.80}; it is text")


def _name(clip: Mapping[str, Any], where: str) -> str:
    """Returns the name of a clip's episode; "" if it has none."""
    name = clip.get("episode", "")
    if isinstance(name, str | int | np.integer) and not isinstance(name, bool):
        with contextlib.suppress(ValueError):  # a number of more digits than Python writes
            return str(name)
    raise StoreError(f"{where}: episode is {name!r:.80}; it is a name, or a number")


def _success(clip: Mapping[str, Any], where: str, count: int) -> Bool[np.ndarray, " T"]:
    success = _as_array(False if clip.get("success") is None else clip["success"], f"{where}: success")
    if success.shape not in ((), (count,)):
        raise StoreError(f"{where}: success has the shape {success.shape}, should be one value or ({count},)")
    if success.dtype.kind not in "biuf" or not np.isin(success, (0, 1)).all():
        raise StoreError(f"{where}: success is {clip['success']!r:.80}, should be True or False")
    return np.broadcast_to(success.astype(bool), (count,)).copy()


def _provenance(clip: Mapping[str, Any], where: str) -> dict[str, Any]:
    origin = {} if clip.get("provenance") is None else clip["provenance"]
    try:
        if not isinstance(origin, Mapping):
            raise TypeError(f"it is a {type(origin).__name__}")
        json.dumps(dict(origin))
        encode(dict(origin))  # which takes integers of 64 bits only
    except (TypeError, ValueError, OverflowError) as error:
        raise StoreError(f"{where}: provenance is not a dict of JSON-ready values ({error})") from error
    return dict(origin)


def _array(
    clip: Mapping[str, Any], name: str, where: str, expected: str, kind: type, shape: tuple[int | None, ...]
) -> np.ndarray:
    """Returns a field as an array of this type and shape; None stands for any length."""
    if clip.get(name) is None:
        raise StoreError(f"{where}: has no {name}; give {expected}")
    array = _as_array(clip[name], f"{where}: {name}")
    fits = array.ndim == len(shape) and all(
        wanted in (None, side) for wanted, side in zip(shape, array.shape, strict=True)
    )
    kinds = "fiu" if kind is np.float32 else np.dtype(kind).kind
    if not fits or array.dtype.kind not in kinds or (kind is np.uint8 and array.dtype != np.uint8) or not array.size:
        raise StoreError(f"{where}: {name} is {array.dtype} {array.shape}, should be {expected}")
    with np.errstate(over="ignore"):
        array = array.astype(kind)
    if kind is np.float32 and not np.isfinite(array).all():
        raise StoreError(f"{where}: {name} has values that are not finite; leave the clip out")
    return array


def _as_array(value: Any, what: str) -> np.ndarray:
    try:
        return np.asarray(value)
    except (TypeError, ValueError) as error:  # lists of other lengths
        raise StoreError(f"{what} cannot be made an array ({error}); give numbers of one shape") from error
