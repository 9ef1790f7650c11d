"""What turns a data set's units into a model's, and back.

Axes: B clips, T frames, A action dimensions.
"""

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from rsjax.data.store import MANIFEST, Store, StoreError
from rsjax.errors import UserError
from rsjax.files import FileError, read_json, write_atomically

_FILE = "units.json"


@dataclass(frozen=True)
class Normalization:
    """Those of a data set.

    Attributes:
        action_mean: of each action dimension over the training split, (A,).
        action_std: likewise.
        depth_range: near and far end of the depth colour map, metres; None where no clip has depth.
    """

    action_mean: tuple[float, ...]
    action_std: tuple[float, ...]
    depth_range: tuple[float, float] | None

    @classmethod
    def create(cls, store: Store) -> "Normalization":
        """The units in a store's manifest.

        Raises:
            StoreError: it names none.
        """
        try:
            return cls._of(store.manifest)
        except (KeyError, TypeError, ValueError) as error:
            where = store.path / MANIFEST
            raise StoreError(f"{where}: no statistics of actions and depth ({error}); make the store again") from error

    @classmethod
    def load(cls, run: Path) -> "Normalization":
        """Those that a run was trained in.

        Raises:
            UserError: they are missing, because the run has not come so far, or damaged.
        """
        path = run / _FILE
        try:
            return cls._of(read_json(path))
        except (FileError, ValueError, KeyError, TypeError) as error:
            raise UserError(f"{path}: missing or damaged ({error}); the train command of this run makes it") from error

    def save(self, run: Path) -> None:
        """Writes what :meth:`load` reads."""
        write_atomically(run / _FILE, json.dumps(asdict(self)).encode())

    @classmethod
    def _of(cls, values: dict[str, Any]) -> "Normalization":
        mean, std, near_far = (values[name] for name in ("action_mean", "action_std", "depth_range"))
        numbers = [*mean, *std, *(near_far or ())]
        if not all(type(number) in (int, float) and math.isfinite(number) for number in numbers):
            raise ValueError(f"numbers are expected, not {numbers!r:.80}")
        if len(mean) != len(std) or (near_far and not (len(near_far) == 2 and near_far[0] < near_far[1])):
            raise ValueError(f"action_mean has {len(mean)} values, action_std {len(std)}; depth_range is {near_far}")
        return cls(tuple(mean), tuple(std), tuple(near_far) if near_far else None)

    def action_inputs(self, actions: Float[np.ndarray, "*B T A"], integrate: bool) -> Float32[np.ndarray, "*B T A2"]:
        """What the action encoder sees: actions at zero mean and unit variance; row 0, into the first frame, is zero.

        A dimension that hardly varies is not blown up: its deviation counts as at least 0.001.

        Args:
            actions: in the data's units.
            integrate: append their sum over the frames so far, at a quarter of its size.
        """
        scaled = (actions - np.asarray(self.action_mean)) / np.maximum(self.action_std, 1e-3)
        scaled[..., 0, :] = 0.0
        if integrate:
            scaled = np.concatenate([scaled, np.cumsum(scaled, axis=-2) / 4.0], axis=-1)
        return scaled.astype(np.float32)
