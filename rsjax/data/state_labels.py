"""What simulators record of each frame beside the picture: labels for heads that read the state from a model's trunk.

Axes: T frames, K quantities.
"""

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any

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
    objects = recorded_objects(record["provenance"])
    recorded = {"success": record.get("success")} | {name: objects.get(name) for name in STATE[1:]}
    labels = np.full((len(record["actions"]), len(STATE)), np.nan, np.float32)
    for column, values in enumerate(recorded.values()):
        if values is not None and np.shape(values) == (len(labels),):
            labels[:, column] = values
    return labels


def recorded_objects(provenance: Mapping[str, Any]) -> dict[str, Any]:
    """Returns what a simulator recorded of objects; lists have a value for each frame. Empty if no simulator did."""
    objects = provenance.get("objects")
    if isinstance(objects, Mapping):  # anybody may write a provenance
        return dict(objects)
    return {}


def provenance_within(provenance: Mapping[str, Any], span: slice) -> dict[str, Any]:
    """Returns the provenance of a clip's frames in a span."""
    objects = recorded_objects(provenance)
    objects |= {name: values[span] for name, values in objects.items() if isinstance(values, list)}
    if objects:
        return dict(provenance) | {"objects": objects}
    return dict(provenance)


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
