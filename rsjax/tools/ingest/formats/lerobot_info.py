"""Reads the head of a LeRobotDataset, ``meta/info.json``: its version, path templates and columns."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rsjax.tools.ingest.episode import MAX_FPS, SourceError
from rsjax.tools.ingest.formats.files import exists, read_json


@dataclass(frozen=True)
class Info:
    """The part of ``meta/info.json`` that reading needs.

    Attributes:
        shared: whether episodes share files (v3).
        fps: frames per second.
        chunks_size: episodes per folder (v2).
        data_path: template of a table's path.
        video_path: template of a video's path, "" without videos.
        features: column → ``dtype``, ``shape``, ``names``.
        episodes: number of episodes that there should be; 0 if the file does not say.
    """

    shared: bool
    fps: float
    chunks_size: int
    data_path: str
    video_path: str
    features: dict[str, dict[str, Any]]
    episodes: int = 0

    def of_type(self, dtype: str) -> list[str]:
        """Returns the camera columns of a dtype (``video`` or ``image``), without coloured depth."""
        keys = []
        for key, feature in self.features.items():
            details = feature.get("info") or feature.get("video_info")
            is_depth = isinstance(details, dict) and details.get("video.is_depth_map")
            if feature.get("dtype") == dtype and not is_depth and "depth" not in key.rpartition(".")[2]:
                keys.append(key)
        return keys


def read_info(path: Path) -> Info:
    """Reads ``meta/info.json``; :class:`SourceError` if a field is missing or of an unknown version."""
    if not exists(path):
        raise SourceError(f"{path}: missing; fetch the file again, or give the folder that has meta/")
    values = read_json(path)
    try:
        version = str(values["codebase_version"])
        if not version.startswith(("v2.", "v3.")):
            raise SourceError(f"{path}: codebase_version {version}; v2.0, v2.1 and v3.0 can be read: convert it")
        info = Info(
            shared=version.startswith("v3."),
            fps=float(values["fps"]),
            chunks_size=int(values.get("chunks_size", 1000)),
            data_path=str(values["data_path"]),
            video_path=str(values.get("video_path") or ""),
            features=dict(values["features"]),
            episodes=int(values.get("total_episodes") or 0),
        )
        if not 0 < info.fps <= MAX_FPS or info.chunks_size <= 0:
            raise ValueError(f"fps {info.fps}, chunks_size {info.chunks_size}")
        if not all(isinstance(feature, dict) for feature in info.features.values()):
            raise ValueError("features are not all objects")
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise SourceError(f"{path}: field missing or wrong ({error}); fetch the file again") from error
    return info
