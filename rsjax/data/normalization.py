"""Normalizes actions and depth, and computes the statistics for it.

Axes: B clips, T frames, A action dimensions, N rows.
"""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64

from rsjax.data.store import MANIFEST, Store, StoreError
from rsjax.errors import UserError
from rsjax.files import FileError, read_json, write_json

FILE = "units.json"


@dataclass(frozen=True)
class Normalization:
    """The numbers that turn a data set's units into a model's.

    Attributes:
        action_mean: mean of each action dimension over the training split, (A,).
        action_std: standard deviation of each action dimension over the training split, (A,).
        depth_range: near and far end of the depth colour map, metres; None if no clip has depth.
    """

    action_mean: tuple[float, ...]
    action_std: tuple[float, ...]
    depth_range: tuple[float, float] | None

    @classmethod
    def create(cls, store: Store) -> "Normalization":
        """Reads the normalization of a store's manifest.

        Raises:
            StoreError: the manifest has no statistics, or depth is constant, so that no colour map can show it.
        """
        near_far = store.manifest.get("depth_range")
        if isinstance(near_far, list) and len(near_far) == 2 and near_far[0] == near_far[1]:
            cure = "make the store again without depth"
            raise StoreError(f"{store.path}: depth is {near_far[0]} everywhere in the train clips; {cure}")
        try:
            return cls._of(store.manifest)
        except (KeyError, TypeError, ValueError) as error:
            where = store.path / MANIFEST
            raise StoreError(f"{where}: no statistics of actions and depth ({error}); make the store again") from error

    @classmethod
    def load(cls, run: Path) -> "Normalization":
        """Reads the normalization that a run was trained with.

        Raises:
            UserError: the file is damaged, or missing because the run has not reached this point.
        """
        path = run / FILE
        try:
            return cls._of(read_json(path))
        except (FileError, ValueError, KeyError, TypeError) as error:
            raise UserError(f"{path}: missing or damaged ({error}); the train command of this run makes it") from error

    @classmethod
    def of(cls, values: Any, path: Path) -> "Normalization":
        """Returns the normalization with these fields, JSON-ready, which are from ``path``.

        Raises:
            UserError: a field is missing or wrong.
        """
        try:
            return cls._of(values)
        except (ValueError, KeyError, TypeError) as error:
            raise UserError(f"{path}: its normalization is damaged ({error}); copy the model again") from error

    def require_depth_range(self) -> tuple[float, float]:
        """Returns ``depth_range``.

        Raises:
            UserError: no clip of the data has depth.
        """
        if self.depth_range is None:
            raise UserError(
                "depth_range is null: no clip of this run's training data has depth, so depth maps cannot be encoded; "
                "pass RGB alone, or train on clips with depth"
            )
        return self.depth_range

    def save(self, run: Path) -> None:
        """Writes what :meth:`load` reads."""
        write_json(run / FILE, asdict(self), sealed=True)

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
        """Returns the inputs of the action encoder: actions as :meth:`scaled`; row 0 is zero.

        Args:
            actions: actions in the data's units; row t leads to frame t.
            integrate: whether to append a quarter of the sum of actions so far; A2 is then 2 A, otherwise A.
        """
        scaled = self.scaled(actions)
        scaled[..., 0, :] = 0.0
        return with_sums(scaled, np.cumsum(scaled, axis=-2) if integrate else None)

    def resting(self) -> Float32[np.ndarray, " A2"]:
        """Returns the inputs of the action encoder, with sums, of one frame after the first in which actions are 0."""
        still = np.zeros((2, len(self.action_mean)))
        return self.action_inputs(still, integrate=True)[1]

    def scaled(self, actions: Float[np.ndarray, "*B A"]) -> Float64[np.ndarray, "*B A"]:
        """Returns actions scaled to zero mean and unit variance.

        A standard deviation below 0.001 counts as 0.001, so that a dimension that hardly varies is not amplified.
        """
        return (actions - np.asarray(self.action_mean)) / np.maximum(self.action_std, 1e-3)


def with_sums(
    scaled: Float[np.ndarray, "*B A"], sums: Float[np.ndarray, "*B A"] | None
) -> Float32[np.ndarray, "*B A2"]:
    """Returns the action encoder's inputs: scaled actions and, if given, a quarter of their sums."""
    rows = scaled if sums is None else np.concatenate([scaled, sums / 4.0], axis=-1)
    return rows.astype(np.float32)


@dataclass(frozen=True)
class Statistics:
    """Statistics of action rows, each (A,), which can be merged over parts of a data set without keeping the rows."""

    count: int
    mean: Float64[np.ndarray, " A"]
    square: Float64[np.ndarray, " A"]  # sum of squared distances from the mean
    low: Float64[np.ndarray, " A"]
    high: Float64[np.ndarray, " A"]

    @classmethod
    def of(cls, rows: Float[np.ndarray, "N A"]) -> "Statistics":
        """Returns the statistics of at least one row. Leave out row 0 of a clip, which is not an action."""
        wide = rows.astype(np.float64)
        mean = wide.mean(0)
        return cls(len(wide), mean, ((wide - mean) ** 2).sum(0), wide.min(0), wide.max(0))

    def merged(self, other: "Statistics") -> "Statistics":
        """Returns the statistics of the rows of both.

        Raises:
            StoreError: the actions have different lengths.
        """
        if len(self.mean) != len(other.mean):
            raise StoreError(f"actions of {len(other.mean)} dimensions among such of {len(self.mean)}; leave it out")
        count = self.count + other.count
        away = other.mean - self.mean
        return Statistics(
            count,
            self.mean + away * other.count / count,
            self.square + other.square + away**2 * self.count * other.count / count,
            np.minimum(self.low, other.low),
            np.maximum(self.high, other.high),
        )

    def to_json(self) -> dict[str, Any]:
        """Returns ``action_count``, ``action_mean``, ``action_std``, ``action_min``, ``action_max``."""
        std = np.sqrt(self.square / self.count)
        arrays = {"mean": self.mean, "std": std, "min": self.low, "max": self.high}
        return {"action_count": self.count} | {f"action_{name}": array.tolist() for name, array in arrays.items()}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> "Statistics":
        """Inverts :meth:`to_json`."""
        mean, std, low, high = (np.array(values[f"action_{name}"]) for name in ("mean", "std", "min", "max"))
        count = values["action_count"]
        return cls(count, mean, std**2 * count, low, high)
