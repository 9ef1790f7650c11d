"""Reads BAIR robot pushing (``softmotion30_44k``): TFRecord files of 256 episodes of 30 steps, pictures as raw bytes.

The files are ``{train,test}/traj_{a}_to_{b}.tfrecords``. Step i has ``{i}/image_main/encoded`` and
``{i}/image_aux1/encoded`` (64×64×3 bytes, RGB), ``{i}/action`` (4) and ``{i}/endeffector_pos`` (3, m). The action of a
step was done after its pictures. Neither times nor tasks are recorded.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from rsjax.files import safe_id
from rsjax.tools.ingest.actions import ActionLayout, align_actions
from rsjax.tools.ingest.episode import MAX_FPS, Episode, EpisodeError, EpisodeRef, SourceError, checked
from rsjax.tools.ingest.formats.files import near
from rsjax.tools.ingest.formats.tfrecord import Example, read_record, record_refs
from rsjax.tools.ingest.pictures import ArrayFrames

SIDE = 64
CAMERAS = {"main": "image_main", "aux1": "image_aux1"}


def open_source(path: Path, fps: float = 5.0) -> "BairSource":
    """Opens the data set.

    Args:
        path: ``softmotion30_44k``, the folder that contains it, one of its two splits, or a single file.
        fps: steps per second. The files do not say; only times in seconds depend on it.

    Raises:
        SourceError: there are no such files, or ``fps`` is not possible.
    """
    if not 0 < fps <= MAX_FPS:
        raise SourceError(f"bair: option fps is {fps}; it must be above 0 and at most {MAX_FPS:g}")
    if path.is_file():
        return BairSource(path.parent, (path.name,), fps)
    once = {file.resolve(): file for file in reversed(near(path, "*.tfrecords"))}  # a link may lead back here
    if not once:
        raise SourceError(f"{path}: no *.tfrecords here or two folders further down; give the folder softmotion30_44k")
    files = sorted(once.values(), key=lambda file: (str(file.parent), _trajectories(file.name)[0], file.name))
    return BairSource(path, tuple(str(file.relative_to(path)) for file in files), fps)


@dataclass(frozen=True)
class BairSource:
    """See :class:`rsjax.tools.ingest.episode.EpisodeSource`.

    Attributes:
        folder: the folder to which the files' names are relative.
        files: the files, in the order of their trajectories.
        fps: steps per second.
    """

    name = "bair"
    folder: Path
    files: tuple[str, ...]
    fps: float

    def episodes(self) -> Iterator[EpisodeRef]:
        """Lists every record of every file; one unreadable entry stands for all that a damaged file lacks."""
        for file in self.files:
            first, last = _trajectories(Path(file).name)
            ids = safe_id(file.removesuffix(".tfrecords").replace("/", "-")) + "-{:03d}"
            yield from record_refs(self.folder, file, ids, (max(1, last - first + 1), "its name promises"), self.fps)

    def read(self, ref: EpisodeRef) -> Episode:
        """Reads one record."""
        example = read_record(self.folder, ref)
        steps = {int(name.partition("/")[0]) for name in example.names() if re.fullmatch(r"\d+/.+", name)}
        count = len(steps)
        if lacking := sorted(set(range(max(count, 1))) - steps):
            raise EpisodeError.at(example.where, f"has no step {lacking[0]}")
        actions = align_actions(_rows(example, "action", count))
        states = _rows(example, "endeffector_pos", count)
        cameras = {}
        for camera, key in CAMERAS.items():
            payloads = []
            for name in (f"{step}/{key}/encoded" for step in range(count)):
                payloads.append(b"".join(example.blobs(name)))
                if (size := len(payloads[-1])) != SIDE * SIDE * 3:
                    raise EpisodeError.at(example.where, f"{name} has {size} bytes, should have {SIDE * SIDE * 3}")
            pictures = np.frombuffer(b"".join(payloads), np.uint8).reshape(count, SIDE, SIDE, 3)
            cameras[camera] = ArrayFrames(pictures)
        episode = Episode(
            id=ref.id,
            fingerprint=ref.fingerprint,
            task="",
            fps=self.fps,
            timestamps=np.arange(count) / self.fps,
            actions=actions,
            states=states,
            cameras=cameras,
            meta={
                "source": "bair",
                "file": ref.location["file"],
                "actions": ActionLayout().to_json(),
                "fps_assumed": True,
            },
        )
        return checked(episode, example.where)


def _trajectories(name: str) -> tuple[int, int]:
    """Returns the first and last trajectory that a file's name promises; -1 if it promises none."""
    match = re.match(r"traj_(\d+)_to_(\d+)", name)
    if match:
        return (int(match[1]), int(match[2]))
    return (-1, -1)


def _rows(example: Example, key: str, count: int) -> Float32[np.ndarray, "N n"]:
    rows = [example.numbers(f"{step}/{key}", 1) for step in range(count)]
    for step, row in enumerate(rows):
        if row.shape != rows[0].shape:
            raise EpisodeError.at(example.where, f"{step}/{key} has {row.size} values, that of step 0 {rows[0].size}")
    return np.concatenate(rows)
