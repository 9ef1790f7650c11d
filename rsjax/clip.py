"""Clips and batches of tokens: each array's shape, dtype, unit and range.

Axes: T frames, H×W pixels, H'×W' token cells, A action dimensions, N₀ tracks, B clips.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from flax import struct
from jaxtyping import Bool, Float, Float32, Int32, UInt8

Array = Any  # JAX or numpy: on a device, or still on the host


@dataclass(frozen=True)
class Clip:
    """One clip of one episode, as numpy arrays.

    Attributes:
        rgb: frames, 0–255, RGB order, upright (row 0 is the top).
        depth: distance along the camera's optical axis in metres (z-depth, not ray length), > 0; None where none was
            recorded or estimated.
        actions: row t led from frame t-1 into frame t; row 0 is zeros (nothing led into the first frame).
        tracks: x (right) and y (down) of each keypoint in each frame; 0 and 1 are the image's outer edges, so the
            centre of pixel column i is (i + 0.5) / W. May leave [0, 1] when the point leaves the image.
        visible: whether the point is inside the image and nothing stands before it. True in frame 0.
        success: the simulator's own success predicate at each frame.
        task: what the robot is asked to do, in words.
        provenance: where the clip comes from (source, seed, episode, camera, expert's settings …), JSON-ready.
    """

    rgb: UInt8[np.ndarray, "T H W 3"]
    depth: Float32[np.ndarray, "T H W"] | None
    actions: Float32[np.ndarray, "T A"]
    tracks: Float32[np.ndarray, "N0 T 2"]
    visible: Bool[np.ndarray, "N0 T"]
    success: Bool[np.ndarray, " T"]
    task: str
    provenance: dict[str, Any] = field(default_factory=dict)


@struct.dataclass
class Batch:
    """Tokenized clips, ready for a training step.

    Attributes:
        rgb: token of each cell, little-endian, 0 … 2^D - 1.
        depth: token of each cell of the colourised depth map, likewise.
        actions: inputs of the action encoder (:meth:`rsjax.data.normalization.Normalization.action_inputs`); row t led
            into frame t.
        tracks: as in :class:`Clip`.
        visible: as in :class:`Clip`.
        weight: 1 for a clip that counts, 0 for padding.
        index: the clip's place in the global batch, so that its random masks don't depend on the device it is on.
        has_depth: 1 for a clip with depth, 0 for one without, whose depth tokens are zeros and never read; None: all
            clips have it.
    """

    rgb: Int32[Array, "B T H W"]
    depth: Int32[Array, "B T H W"]
    actions: Float[Array, "B T A"]
    tracks: Float[Array, "B N0 T 2"]
    visible: Bool[Array, "B N0 T"]
    weight: Float[Array, " B"]
    index: Int32[Array, " B"]
    has_depth: Float[Array, " B"] | None = None
