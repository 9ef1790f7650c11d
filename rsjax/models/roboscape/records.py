"""Converts token records to arrays and arrays to batches, in the loader. Plain numpy."""

import numpy as np
from flax import struct
from jaxtyping import Bool, Float, Int32

from rsjax.clip import Array
from rsjax.config import ClipShape
from rsjax.data.codec import Record
from rsjax.data.normalization import Normalization
from rsjax.data.order import Arrays
from rsjax.models.roboscape.departures.shifts import drawn_copy


@struct.dataclass
class Batch:
    """Tokenized clips for a training step.

    Attributes:
        rgb: token of each cell, little-endian, 0 … 2^D - 1.
        depth: token of each cell of the colourised depth map, likewise.
        actions: inputs of the action encoder (:meth:`rsjax.data.normalization.Normalization.action_inputs`); row t led
            into frame t.
        tracks: as in :class:`rsjax.clip.Clip`.
        visible: as in :class:`rsjax.clip.Clip`.
        weight: 1 for a clip that counts, 0 for padding.
        index: the clip's place in the global batch, which decides its random masks whichever device it is on.
        has_depth: 1 for a clip with depth, 0 for one without, whose depth tokens are zeros and never read; None: all
            clips have depth.
    """

    rgb: Int32[Array, "B T H W"]
    depth: Int32[Array, "B T H W"]
    actions: Float[Array, "B T A"]
    tracks: Float[Array, "B N0 T 2"]
    visible: Bool[Array, "B N0 T"]
    weight: Float[Array, " B"]
    index: Int32[Array, " B"]
    has_depth: Float[Array, " B"] | None = None


ARRAYS = ("rgb", "depth", "actions", "tracks", "visible", "has_depth")


def token_arrays(normalization: Normalization, integrate: bool, record: Record, rng: np.random.Generator) -> Arrays:
    """Returns the arrays of a token record that a training step reads.

    Args:
        normalization: that of the run's own store, even for records of other stores.
        integrate: whether to append the actions' sums (see ``Normalization.action_inputs``).
        rng: chooses among the clip and its moved copies, if it has any.
    """
    record = drawn_copy(record, rng)
    has_depth = record["depth"] is not None
    depth = record["depth"] if has_depth else np.zeros_like(record["rgb"])
    return {
        "rgb": record["rgb"],
        "depth": depth,
        "actions": normalization.action_inputs(record["actions"], integrate),
        "tracks": record["tracks"],
        "visible": record["visible"],
        "has_depth": np.array(has_depth, np.float32),
    }


def token_batch(arrays: Arrays) -> Batch:
    """Returns stacked :func:`token_arrays` as a :class:`Batch`.

    ``weight`` is 1 and ``index`` the row by default.
    """
    size = len(arrays["rgb"])
    weight = arrays.get("weight", np.ones(size, np.float32))
    index = arrays.get("index", np.arange(size, dtype=np.int32))
    return Batch(**{name: arrays[name] for name in ARRAYS}, weight=weight, index=index)


def random_record(rng: np.random.Generator, clips: ClipShape, grid: int, code_bits: int) -> Record:
    """Returns a token record with random contents."""
    tokens = rng.integers(0, 2**code_bits, (2, clips.frames, grid, grid), np.int32)
    return {
        "rgb": tokens[0],
        "depth": tokens[1],
        "actions": rng.normal(size=(clips.frames, clips.action_dim)).astype(np.float32),
        "tracks": rng.random((clips.tracks, clips.frames, 2), np.float32),
        "visible": rng.random((clips.tracks, clips.frames)) < 0.9,
        "task": "",
        "provenance": {},
    }
