"""A folder of videos with a table of actions, for data of one's own.

One folder per episode, whose name is the episode's::

    PATH/dataset.json             optional: {"task": "fold the towel", "fps": 30, "rows": "given", "kind": "delta", …}
    PATH/EPISODE/CAMERA.mp4       one per camera; or a folder CAMERA/ of pictures 000000.png …
    PATH/EPISODE/CAMERA.depth/    optional: 16-bit PNG depth maps in millimetres, one per frame
    PATH/EPISODE/actions.csv      or .parquet or .npy: a row per frame
    PATH/EPISODE/episode.json     optional: {"task": …, "fps": …, "segments": [{"start", "end", "text", "skill"}]}

or, with one camera, flat: ``PATH/NAME.mp4``, ``PATH/NAME.csv`` and, optionally, ``PATH/NAME.json``.

The columns of a table have names: ``timestamp`` (seconds), ``state…``, and ``action…``; where none begins with
``action``, all that are left are the action. A ``.npy`` array (N, A) holds actions alone. ``rows`` says what a row is:
``given`` at its frame, so that it leads into the next one (then the last row may be missing), or ``led``: it led into
its frame. ``fps`` is needed with pictures and without timestamps; videos know their own.
"""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
from jaxtyping import Float, Float32

from rsjax.ingest.actions import Kind, Layout, check_layout, led_into
from rsjax.ingest.episode import (
    Episode,
    EpisodeError,
    EpisodeRef,
    Frames,
    SourceError,
    checked,
    fingerprint,
    safe_id,
)
from rsjax.ingest.formats import folder_parts as parts
from rsjax.ingest.formats.files import inside, is_there, location_of, read_json, seconds, subfolders
from rsjax.ingest.formats.folder_config import FolderConfig, Rows
from rsjax.ingest.video import VideoFrames, scan


class Folder:
    """A folder of videos, as :class:`rsjax.ingest.episode.EpisodeSource`; made by :func:`open_source`."""

    name = "folder"

    def __init__(self, root: Path, config: FolderConfig) -> None:
        self._root, self._config = root, config

    def episodes(self) -> Iterator[EpisodeRef]:
        """Folders first, then the files that make up flat episodes, each by name."""
        folders, flat = subfolders(self._root), 0
        for folder in folders:
            yield self._ref(folder.name, flat=False)
        beside: dict[str, list[Path]] = {}
        for path in self._root.iterdir():
            if path.suffix.lower() in (*parts.VIDEOS, *parts.TABLES, ".json"):
                beside.setdefault(path.stem, []).append(path)
        for name, files in sorted(beside.items()):
            if any(path.suffix.lower() != ".json" for path in files):
                flat += 1
                yield self._ref(name, flat=True, files=sorted(files))
        if not folders and not flat:
            raise SourceError(f"{self._root}: holds no episode: no folder, video or table; give the one that does")

    def read(self, ref: EpisodeRef) -> Episode:
        """One episode."""
        location = location_of(ref)
        place = inside(self._root, location["name"])
        try:
            return self._read(ref, location["name"], location["flat"], place)
        except OSError as error:
            raise EpisodeError(f"{place}: cannot be read ({error.strerror}); check its permissions") from error

    def _read(self, ref: EpisodeRef, name: str, flat: bool, place: Path) -> Episode:
        files = self._files(name, flat)
        cameras, depth = parts.cameras_of(files, flat)
        table_path = parts.one_table(files, place)
        told = parts.Told.read(place.with_name(f"{name}.json") if flat else place / "episode.json")
        if not cameras:
            kinds = ", ".join(parts.VIDEOS)
            raise EpisodeError(f"{place}: has no video ({kinds}) and no folder of pictures; add one or leave it out")
        count = len(next(iter(cameras.values())))
        table, fps = parts.read_table(table_path), told.fps or self._config.fps
        actions, states = parts.action_columns(table), parts.state_columns(table)
        commands = parts.columns(table, actions, table_path)
        layout = Layout(self._config.kind, self._config.quaternions, self._config.held)
        check_layout(layout, commands.shape[1], table_path)
        times = self._times(table, cameras, fps, count, place)
        if len(times) != count:
            rows = f"{len(times)} timestamps for {count} pictures"
            raise EpisodeError(f"{table_path}: {rows}; one row per frame", "length")
        episode = Episode(
            id=ref.id,
            fingerprint=ref.fingerprint,
            task=self._config.task if told.task is None else told.task,
            fps=fps or _rate(times),
            timestamps=times - times[0],
            actions=self._actions(commands, count, table_path),
            states=parts.columns(table, states, table_path) if states else None,
            cameras=cameras,
            depth=depth,
            segments=told.segments(count),
            meta={
                "actions": layout.to_json(),
                "action_names": actions,
            },
        )
        return checked(episode, table_path)

    def _files(self, name: str, flat: bool) -> list[Path]:
        """What an episode is made of, as far as names tell."""
        try:
            if flat:
                found = [path for path in self._root.iterdir() if path.stem == name and not path.is_dir()]
            else:
                found = [path for path in (self._root / name).iterdir() if not path.name.startswith(".")]
        except OSError as error:
            raise EpisodeError(f"{self._root / name}: cannot be listed ({error.strerror}); leave it out") from error
        return sorted(found)

    def _ref(self, name: str, flat: bool, files: Sequence[Path] | None = None) -> EpisodeRef:
        sizes = []
        try:
            files = self._files(name, flat) if files is None else files
            for folder in filter(Path.is_dir, files):  # pictures are too many to look into
                sizes += sorted((folder.name, path.name, path.stat().st_size) for path in folder.iterdir())
        except (EpisodeError, OSError):
            files = []  # reading it tells why
        config = dataclasses.asdict(self._config)
        identity = safe_id(f"{name}.flat" if flat and (self._root / name).is_dir() else name)
        return EpisodeRef(identity, fingerprint(files, name, sizes, config), {"name": name, "flat": flat})

    def _times(
        self, table: pa.Table, cameras: Mapping[str, Frames], fps: float, count: int, place: Path
    ) -> Float[np.ndarray, " N"]:
        """Seconds: the table's, or those of the given rate, or the first video's own."""
        if "timestamp" in table.column_names:
            return seconds(table, "timestamp", place)
        if fps:
            return np.arange(count) / fps
        for frames in cameras.values():
            if isinstance(frames, VideoFrames):
                return scan(frames.path).times()
        raise EpisodeError(f"{place}: how fast are its pictures? Give fps in dataset.json or timestamps")

    def _actions(self, rows: Float32[np.ndarray, "N A"], count: int, path: Path) -> Float32[np.ndarray, "N A"]:
        if self._config.rows == "given" and len(rows) == count - 1:
            rows = np.concatenate([rows, rows[-1:]])  # what is given at the last frame leads nowhere
        if len(rows) != count:
            told = f"{path}: {len(rows)} rows of actions for {count} pictures; one row per frame"
            raise EpisodeError(told, "length")
        if self._config.rows == "given":
            return led_into(rows)
        return np.concatenate([np.zeros_like(rows[:1]), rows[1:]])


def _rate(times: Float[np.ndarray, " N"]) -> float:
    """Frames per second by the median interval; 1 where there is none that time could be counted by."""
    interval = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    return 1 / interval if interval > 0 else 1.0


def open_source(
    path: Path,
    *,
    task: str | None = None,
    fps: float | None = None,
    rows: Rows | None = None,
    kind: Kind | None = None,
    held: Sequence[int] | None = None,
    quaternions: Sequence[int] | None = None,
) -> Folder:
    """The data set at ``path``; options as in :class:`FolderConfig`, None: as ``dataset.json`` says.

    Raises:
        SourceError: ``dataset.json`` or an option is wrong, or ``path`` is no folder.
    """
    if not path.is_dir():
        raise SourceError(f"{path}: not a folder; give the one that holds the episodes")
    given = {"task": task, "fps": fps, "rows": rows, "kind": kind, "held": held, "quaternions": quaternions}
    config = path / "dataset.json"
    values = read_json(config) if is_there(config) else {}
    FolderConfig.of(values, config)
    return Folder(path, FolderConfig.of(values | {k: v for k, v in given.items() if v is not None}, path))
