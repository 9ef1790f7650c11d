"""BAIR robot pushing (``softmotion30_44k``): TFRecord files of 256 episodes of 30 steps, pictures as raw bytes.

``{train,test}/traj_{a}_to_{b}.tfrecords``; of step i ``{i}/image_main/encoded`` and ``{i}/image_aux1/encoded`` (64×64×3
bytes, RGB), ``{i}/action`` (4) and ``{i}/endeffector_pos`` (3 m). The action of a step is what was done after its
pictures. Neither times nor tasks are recorded.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32, UInt8

from rsjax.ingest.actions import Layout, led_into
from rsjax.ingest.episode import (
    MAX_FPS,
    Episode,
    EpisodeError,
    EpisodeRef,
    SourceError,
    checked,
    fingerprint,
    safe_id,
)
from rsjax.ingest.formats.tfrecord import Example, Span, read_payload, spans

SIDE = 64
CAMERAS = {"main": "image_main", "aux1": "image_aux1"}
_CURE = "fetch the file again or leave the episode out"


def open_source(path: Path, fps: float = 5.0) -> "BairSource":
    """The data set.

    Args:
        path: ``softmotion30_44k``, the folder that holds it, one of its two splits, or a single file.
        fps: steps per second. The files do not say; only times in seconds depend on it.

    Raises:
        SourceError: there are no such files, or ``fps`` is not possible.
    """
    if not 0 < fps <= MAX_FPS:
        raise SourceError(f"bair: option fps is {fps}; it must be above 0 and at most {MAX_FPS:g}")
    if path.is_file():
        return BairSource(path.parent, (path.name,), fps)
    found = [file for depth in ("", "*/", "*/*/") for file in path.glob(f"{depth}*.tfrecords") if file.is_file()]
    if not found:
        raise SourceError(f"{path}: no *.tfrecords here or two folders further down; give the folder softmotion30_44k")
    once = {file.resolve(): file for file in reversed(found)}  # a link may lead back here
    files = sorted(once.values(), key=lambda file: (str(file.parent), _first(file), file.name))
    return BairSource(path, tuple(str(file.relative_to(path)) for file in files), fps)


@dataclass(frozen=True)
class BairSource:
    """See :class:`rsjax.ingest.episode.EpisodeSource`.

    Attributes:
        folder: what the files' names are relative to.
        files: in the order of their trajectories.
        fps: steps per second.
    """

    name = "bair"
    folder: Path
    files: tuple[str, ...]
    fps: float

    def episodes(self) -> Iterator[EpisodeRef]:
        """From the heads of the records alone. What a damaged file lacks is one entry, which ``read`` refuses."""
        for file in self.files:
            stem = safe_id(file.removesuffix(".tfrecords").replace("/", "-"))
            for number, span in enumerate(_records(self.folder / file)):
                where = {"file": file, "offset": span.offset, "length": span.length, "damage": span.damage}
                marks = fingerprint((), file, span.length, span.crc, span.damage, self.fps)
                yield EpisodeRef(f"{stem}-{number:03d}", marks, where)

    def read(self, ref: EpisodeRef) -> Episode:
        """One record."""
        if ref.location["file"] not in self.files:
            raise EpisodeError(f"{self.folder}: holds no file {ref.location['file']!r} of its own; list it again")
        path = self.folder / ref.location["file"]
        if ref.location["damage"]:
            raise EpisodeError(f"{path}: {ref.location['damage']}; {_CURE}")
        where = f"{path}: record {ref.id}"
        example = Example(read_payload(path, ref.location["offset"], ref.location["length"]), where)
        count = _steps(example)
        episode = Episode(
            id=ref.id,
            fingerprint=ref.fingerprint,
            task="",
            fps=self.fps,
            timestamps=np.arange(count) / self.fps,
            actions=led_into(_rows(example, "action", count)),
            states=_rows(example, "endeffector_pos", count),
            cameras={name: _frames(example, key, count) for name, key in CAMERAS.items()},
            meta={"source": "bair", "file": ref.location["file"], "actions": Layout().to_json(), "fps_assumed": True},
        )
        return checked(episode, where)


class RawFrames:
    """Pictures as raw bytes in memory, as :class:`rsjax.ingest.episode.Frames`.

    Args:
        payloads: each frame's 64·64·3 bytes.
    """

    def __init__(self, payloads: Sequence[bytes]) -> None:
        self._payloads = list(payloads)

    def __len__(self) -> int:
        return len(self._payloads)

    def read(self, indices: Sequence[int]) -> UInt8[np.ndarray, "n 64 64 3"]:
        """These pictures."""
        chosen = b"".join(self._payloads[index] for index in indices)
        return np.frombuffer(chosen, np.uint8).reshape(-1, SIDE, SIDE, 3)


def _records(path: Path) -> list[Span]:
    """The records of a file and, where a file without other damage lacks some, one entry that says so."""
    found, promised = list(spans(path)), _promised(path.name)
    if len(found) < promised and not (found and found[-1].damage):
        damage = f"holds {len(found)} of the {promised} records that its name promises"
        found.append(Span(0, 0, damage=damage))
    return found


def _promised(name: str) -> int:
    """How many records a file has by its name, ``traj_0_to_255``; one at least."""
    match = re.match(r"traj_(\d+)_to_(\d+)", name)
    return max(1, int(match[2]) - int(match[1]) + 1) if match else 1


def _steps(example: Example) -> int:
    """How many steps there are, from 0 on, without a gap.

    Raises:
        EpisodeError: a step is missing, or there are none.
    """
    steps = {int(name.partition("/")[0]) for name in example.names() if re.fullmatch(r"\d+/.+", name)}
    lacking = sorted(set(range(len(steps))) - steps)
    if not steps or lacking:
        raise EpisodeError(f"{example.where}: has no step {lacking[0] if lacking else 0}; {_CURE}")
    return len(steps)


def _rows(example: Example, key: str, count: int) -> Float32[np.ndarray, "N n"]:
    rows = [example.numbers(f"{step}/{key}", 1) for step in range(count)]
    for step, row in enumerate(rows):
        if row.shape != rows[0].shape:
            raise EpisodeError(
                f"{example.where}: {step}/{key} has {row.size} values, that of step 0 {rows[0].size}; {_CURE}"
            )
    return np.concatenate(rows)


def _frames(example: Example, key: str, count: int) -> RawFrames:
    payloads = []
    for step in range(count):
        name = f"{step}/{key}/encoded"
        payload = b"".join(example.blobs(name))
        if len(payload) != SIDE * SIDE * 3:
            raise EpisodeError(
                f"{example.where}: {name} has {len(payload)} bytes, should have {SIDE * SIDE * 3}; {_CURE}"
            )
        payloads.append(payload)
    return RawFrames(payloads)


def _first(file: Path) -> int:
    """The trajectory that a file's name begins with."""
    match = re.match(r"traj_(\d+)_to_", file.name)
    return int(match[1]) if match else -1
