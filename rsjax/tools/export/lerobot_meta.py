"""Features, statistics and tables of a LeRobotDataset.

Axes: T frames, D numbers of a column, N rows or pixels, H×W pixels.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Num, UInt8

from rsjax.tools.export.lerobot_video import VideoSettings

QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
COUNTERS = {"timestamp": "float32", "frame_index": "int64", "episode_index": "int64", "index": "int64"}
COUNTERS |= {"task_index": "int64"}

Stats = dict[str, dict[str, np.ndarray]]  # feature → min, max, mean, std, count and quantiles


def describe_features(
    video: VideoSettings, camera: str, action: Sequence[str], state: Sequence[str] | None
) -> dict[str, dict[str, Any]]:
    """Returns the ``features`` of ``info.json``: one camera, the action, a state if there is one, and row counters."""
    pictures = {"dtype": "video", "shape": [video.size, video.size, 3], "names": ["height", "width", "channels"]}
    features: dict[str, dict[str, Any]] = {f"observation.images.{camera}": pictures | {"info": video.describe()}}
    numbers = {"observation.state": state, "action": action}
    for name, names in numbers.items():
        if names is not None:
            features[name] = {"dtype": "float32", "shape": [len(names)], "names": list(names)}
    return features | {name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in COUNTERS.items()}


def rows_table(columns: Mapping[str, Num[np.ndarray, "T ..."]]) -> pa.Table:
    """Returns columns as a table; columns with several numbers per row become lists of fixed length, as in LeRobot.

    A column with one number per row becomes scalars, even if it has two axes: that is how LeRobot reads the shape [1].
    """
    arrays: dict[str, pa.Array] = {}
    for name, values in columns.items():
        flat, width = pa.array(np.ascontiguousarray(values).reshape(-1)), values.size // len(values)
        arrays[name] = pa.FixedSizeListArray.from_arrays(flat, width) if width > 1 else flat
    return pa.table(arrays)


def column_stats(values: Num[np.ndarray, "T ..."]) -> dict[str, np.ndarray]:
    """Returns one column's statistics over an episode, each (D,) or (1,); "std" is that of the population (1 / T)."""
    wide = values.astype(np.float64).reshape(len(values), -1)
    return _stats(wide, len(values))


def picture_stats(rgb: UInt8[np.ndarray, "T H W 3"]) -> dict[str, np.ndarray]:
    """Returns the statistics of pictures by channel, each (3, 1, 1), of values from 0 to 1; ``count`` is T."""
    pixels = rgb.reshape(-1, 3).astype(np.float64) / 255
    stats = _stats(pixels, len(rgb))
    return {name: value if name == "count" else value.reshape(3, 1, 1) for name, value in stats.items()}


def _stats(rows: Num[np.ndarray, "N D"], count: int) -> dict[str, np.ndarray]:
    quantiles = np.quantile(rows, list(QUANTILES.values()), axis=0)
    stats = {"min": rows.min(0), "max": rows.max(0), "mean": rows.mean(0), "std": rows.std(0)}
    return stats | {"count": np.array([count])} | dict(zip(QUANTILES, quantiles, strict=True))


def merged_stats(one: Stats, other: Stats) -> Stats:
    """Returns the statistics of both together; quantiles become weighted means, as in LeRobot's own aggregation."""
    return {name: _merged(one[name], other[name]) for name in one} if one else other


def _merged(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    count = one["count"] + other["count"]
    share = float(other["count"][0] / count[0])
    mixed = {name: (1 - share) * one[name] + share * other[name] for name in ("mean", *QUANTILES)}
    spread = [stats["std"] ** 2 + (stats["mean"] - mixed["mean"]) ** 2 for stats in (one, other)]
    ends = {"min": np.minimum(one["min"], other["min"]), "max": np.maximum(one["max"], other["max"])}
    return mixed | ends | {"std": np.sqrt((1 - share) * spread[0] + share * spread[1]), "count": count}


def plain_stats(stats: Stats, quantiles: bool = True) -> dict[str, Any]:
    """Returns statistics JSON-ready, on request without quantiles, which v2.1 does not have."""
    return {
        feature: {name: value.tolist() for name, value in values.items() if quantiles or name not in QUANTILES}
        for feature, values in stats.items()
    }


def write_tasks(path: Path, tasks: Sequence[str]) -> None:
    """Writes ``tasks.parquet`` of v3.0: a pandas frame of ``task_index`` whose index is the task's text."""
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": pa.array(tasks, pa.string())})
    columns = [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
        for name, kind, numpy in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ]
    pandas = {
        "index_columns": ["task"],
        "column_indexes": [],
        "columns": columns,
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.2.0",
    }
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(pandas)}), path)
