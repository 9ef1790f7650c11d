"""Converts token records to arrays and arrays to batches, in the loader. Plain numpy."""

import numpy as np

from rsjax.config import BackwardsConfig, ClipShape
from rsjax.data.codec import Record
from rsjax.data.loader import Arrays
from rsjax.data.normalization import Normalization
from rsjax.data.state_labels import state_labels
from rsjax.models.roboscape.departures.backwards import drawn_direction
from rsjax.models.roboscape.departures.second_view import SECOND
from rsjax.models.roboscape.departures.shifts import drawn_copy
from rsjax.models.roboscape.objective import Batch

ARRAYS = ("rgb", "depth", "actions", "tracks", "visible", "has_depth")


def token_arrays(
    normalization: Normalization,
    integrate: bool,
    record: Record,
    rng: np.random.Generator,
    state: bool = False,
    second_view: bool = False,
    backwards: BackwardsConfig | None = None,
) -> Arrays:
    """Returns the arrays of a token record that a training step reads.

    Args:
        normalization: that of the run's own store, even for records of other stores.
        integrate: whether to append the actions' sums (see ``Normalization.action_inputs``).
        rng: chooses among the clip and its moved copies, if it has any, and the direction.
        state: whether to add the labels of the state heads.
        second_view: whether to add the tokens of the second view.
        backwards: which clips run backwards.
    """
    record = drawn_direction(backwards, drawn_copy(record, rng), rng)
    has_depth = record["depth"] is not None
    depth = record["depth"] if has_depth else np.zeros_like(record["rgb"])
    arrays = {
        "rgb": record["rgb"],
        "depth": depth,
        "actions": normalization.action_inputs(record["actions"], integrate),
        "tracks": record["tracks"],
        "visible": record["visible"],
        "has_depth": np.array(has_depth, np.float32),
    }
    if second_view:
        arrays[SECOND] = record[SECOND]
    if state:
        arrays["state"] = state_labels(record)
    return arrays


def token_batch(arrays: Arrays) -> Batch:
    """Returns stacked :func:`token_arrays` as a :class:`Batch`.

    ``weight`` is 1 and ``index`` the row by default.
    """
    size = len(arrays["rgb"])
    weight = arrays.get("weight", np.ones(size, np.float32))
    index = arrays.get("index", np.arange(size, dtype=np.int32))
    more = {name: arrays[name] for name in ("state", SECOND) if name in arrays}
    return Batch(**{name: arrays[name] for name in ARRAYS}, weight=weight, index=index, **more)


def random_record(
    rng: np.random.Generator, clips: ClipShape, grid: int, code_bits: int, second_view: bool = False
) -> Record:
    """Returns a token record with random contents."""
    tokens = rng.integers(0, 2**code_bits, (2 + second_view, clips.frames, grid, grid), np.int32)
    streams = ("rgb", "depth", SECOND)
    return dict(zip(streams, tokens, strict=False)) | {
        "actions": rng.normal(size=(clips.frames, clips.action_dim)).astype(np.float32),
        "tracks": rng.random((clips.tracks, clips.frames, 2), np.float32),
        "visible": rng.random((clips.tracks, clips.frames)) < 0.9,
        "task": "",
        "provenance": {},
    }
