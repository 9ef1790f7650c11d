"""What simulators record of each frame beside the picture: labels for heads that read the state from a model's trunk.

Axes: T frames, K quantities.
"""

from collections import Counter
from collections.abc import Iterable

import numpy as np
from jaxtyping import Float32

from rsjax.data.codec import Record
from rsjax.data.store import Store

# Whether the task is done, the main object's height above the table in metres, and the distance between the gripper's
# fingers in metres. Columns of ``Video.state``.
STATE = ("success", "height", "opening")


def state_labels(record: Record) -> Float32[np.ndarray, "T K"]:
    """Returns the recorded state of every frame, a column for each of ``STATE``; NaN where it is unknown.

    Args:
        record: of a clip or of its tokens. Success is unknown without a field ``success``, as in records of data sets
            that do not say which attempts succeed; height and opening are in the provenance of simulated clips.
    """
    objects = record["provenance"].get("objects") or {}
    recorded = {"success": record.get("success")} | {name: objects.get(name) for name in STATE[1:]}
    labels = np.full((len(record["actions"]), len(STATE)), np.nan, np.float32)
    for column, values in enumerate(recorded.values()):
        if values is not None:
            labels[:, column] = values
    return labels


def knows_success(store: Store) -> bool:
    """Returns whether a store says which of its clips succeed; otherwise the field ``success`` of clips is False."""
    return store.manifest.get("success_share") is not None


def missing_labels(records: Iterable[Record]) -> dict[str, int]:
    """Returns in how many of these records frames lack each quantity of ``STATE``; without those that none lacks."""
    missing = Counter[str]()
    for record in records:
        unknown = np.isnan(state_labels(record)).any(axis=0)
        missing.update(name for name, lacks in zip(STATE, unknown, strict=True) if lacks)
    return dict(missing)
