"""The head of a LeRobotDataset, ``meta/info.json``: its version, path templates and columns."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rsjax.ingest.episode import MAX_FPS, SourceError
from rsjax.ingest.formats.files import is_there, read_json


@dataclass(frozen=True)
class Info:
    """What is needed of ``meta/info.json``.

    Attributes:
        shared: whether episodes share files (v3).
        fps: frames per second.
        chunks_size: episodes to a folder (v2).
        data_path: template of a table's path.
        video_path: template of a video's path, "" without videos.
        features: column → ``dtype``, ``shape``, ``names``.
        episodes: how many there should be; None where it is not said.
    """

    shared: bool
    fps: float
    chunks_size: int
    data_path: str
    video_path: str
    features: dict[str, dict[str, Any]]
    episodes: int | None = None

    @classmethod
    def read(cls, path: Path) -> "Info":
        """Raises :class:`SourceError` where a field is missing or of a version that is not known."""
        if not is_there(path):
            raise SourceError(f"{path}: missing; fetch the file again, or give the folder that has meta/")
        values = read_json(path)
        try:
            version = str(values["codebase_version"])
            if not version.startswith(("v2.", "v3.")):
                raise SourceError(f"{path}: codebase_version {version}; v2.0, v2.1 and v3.0 can be read: convert it")
            fps, features = float(values["fps"]), dict(values["features"])
            chunks = int(values.get("chunks_size", 1000))
            total = values.get("total_episodes")
            if not (
                0 < fps <= MAX_FPS and chunks > 0 and all(isinstance(feature, dict) for feature in features.values())
            ):
                raise ValueError(f"fps {fps}, chunks_size {chunks}")
            paths = str(values["data_path"]), str(values.get("video_path") or "")
            return cls(version.startswith("v3."), fps, chunks, *paths, features, None if total is None else int(total))
        except (KeyError, TypeError, ValueError, OverflowError) as error:
            raise SourceError(f"{path}: field missing or wrong ({error}); fetch the file again") from error

    def of_type(self, dtype: str) -> list[str]:
        """The camera columns of a dtype (``video`` or ``image``), without those that are coloured depth."""
        return [
            key
            for key, feature in self.features.items()
            if feature.get("dtype") == dtype and not _is_depth(feature) and "depth" not in key.rpartition(".")[2]
        ]


def _is_depth(feature: dict[str, Any]) -> bool:
    details = feature.get("info") or feature.get("video_info") or {}
    return bool(isinstance(details, dict) and details.get("video.is_depth_map"))
