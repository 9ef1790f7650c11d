"""Recorded actions to the actions of a clip: which command led from one *sampled* frame into the next.

An :class:`rsjax.ingest.episode.Episode` has a row of actions for each recorded frame, in its data set's units. A clip
keeps every tenth frame or so; what led from one kept frame into the next is made of the rows between them, in the way
that :class:`ActionConfig` says and :class:`Layout` allows.

Axes: N recorded frames, T sampled frames, K rows between two of these, A recorded and A' resulting action dimensions.
"""

import itertools
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from jaxtyping import Float, Float32, Float64, Int

from rsjax.config.fields import ConfigError
from rsjax.ingest.episode import EpisodeError

Kind = Literal["absolute", "delta"]
Compose = Literal["join", "last", "stack"]


@dataclass(frozen=True)
class Layout:
    """What the numbers of an action mean; readers leave it in ``episode.meta["actions"]``.

    Attributes:
        kind: absolute: where to be; delta: how far to go, or a velocity or torque of the step.
        quaternions: first of the four dimensions of each unit quaternion, x y z w.
        held: dimensions that are commands to be in a state (open, closed) whatever ``kind`` says. They have no
            differences, and of several the last one counts.
    """

    kind: Kind = "delta"
    quaternions: tuple[int, ...] = ()
    held: tuple[int, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """As :meth:`from_json` reads it."""
        return asdict(self) | {"quaternions": list(self.quaternions), "held": list(self.held)}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> "Layout":
        """The inverse of :meth:`to_json`; what is not named has its default."""
        return cls(values.get("kind", "delta"), tuple(values.get("quaternions", ())), tuple(values.get("held", ())))


@dataclass(frozen=True)
class ActionConfig:
    """How a source's actions are handled.

    Attributes:
        offset: frames by which the commands of this source are recorded too early (> 0) or too late (< 0), beyond its
            format's documented alignment, which the reader undoes: row t becomes the one recorded at t - offset.
        compose: what becomes of the rows between two sampled frames. ``join``: one row that does the same: deltas are
            added, quaternions multiplied, of absolute and held dimensions the last counts. ``last``: the last row.
            ``stack``: all rows, one after the other (A' = K·A); the frames must be evenly spaced.
        kind: what the clip's actions are: ``recorded``, or ``delta`` of what was recorded as ``absolute``.
    """

    offset: int = 0
    compose: Compose = "join"
    kind: Literal["recorded", "absolute", "delta"] = "recorded"

    def __post_init__(self) -> None:
        for name, allowed in (("compose", get_args(Compose)), ("kind", ("recorded", "absolute", "delta"))):
            if getattr(self, name) not in allowed:
                raise ConfigError(f"actions.{name} is {getattr(self, name)!r}; choose one of {', '.join(allowed)}")


def check_layout(layout: Layout, width: int, where: Path | str) -> None:
    """Raises :class:`EpisodeError` where a layout names dimensions that actions of this width do not have.

    Args:
        where: what the message names.
    """
    named = {
        "held": layout.held,
        "quaternions": [dim for first in layout.quaternions for dim in (first, first + 3)],
    }
    for name, dims in named.items():
        for wrong in (dim for dim in dims if not 0 <= dim < width):
            raise EpisodeError(
                f"{where}: {name} names dimension {wrong}, but actions have {width} (from 0 on); mend the option {name}"
            )


def led_into(commands: Float[np.ndarray, "N A"]) -> Float32[np.ndarray, "N A"]:
    """Commands given at each frame, aligned with the frame that each led into: row 0 is zeros, the last is dropped."""
    aligned = np.zeros(commands.shape, np.float32)
    aligned[1:] = commands[:-1]
    return aligned


def sampled_actions(
    actions: Float32[np.ndarray, "N A"], frames: Int[np.ndarray, " T"], config: ActionConfig, layout: Layout
) -> Float32[np.ndarray, "T A2"]:
    """What led into each of these frames from the one before it in ``frames``; row 0 is zeros.

    Args:
        actions: an episode's; row t led into frame t, row 0 means nothing.
        frames: numbers of the sampled frames, increasing, each below N.
        config: how.
        layout: of ``actions``.

    Raises:
        ConfigError: absolute actions are asked of deltas, or ``stack`` of frames that are not evenly spaced.
        EpisodeError: the layout names dimensions that the actions do not have.
    """
    check_layout(layout, actions.shape[1], "meta.actions")
    if config.kind == "absolute" and layout.kind == "delta":
        raise ConfigError("actions.kind is 'absolute', but the source records deltas; say 'recorded' or 'delta'")
    gaps = np.diff(frames)
    if config.compose == "stack" and len(set(gaps.tolist())) > 1:
        raise ConfigError(f"actions.compose is 'stack', but frames are {gaps.min()} to {gaps.max()} apart; say 'join'")
    rows = _shifted(actions.astype(np.float64), config.offset, layout)
    differences = config.kind == "delta" and layout.kind == "absolute"
    if differences:
        rows = _differences(rows, layout)
    added = differences or layout.kind == "delta"
    made = [
        _composed(rows[before + 1 : after + 1], config.compose, layout, added)
        for before, after in itertools.pairwise(frames)
    ]
    width = made[0].size if made else actions.shape[1]
    return np.stack([np.zeros(width), *made]).astype(np.float32)


def unflipped(quaternions: Float[np.ndarray, "N 4"]) -> Float[np.ndarray, "N 4"]:
    """The same rotations, each with the sign that is nearer to the one before; q and -q are one rotation."""
    flips = np.sum(quaternions[1:] * quaternions[:-1], -1) < 0
    signs = np.concatenate([[1.0], np.where(np.cumsum(flips) % 2, -1.0, 1.0)])
    return quaternions * signs[: len(quaternions), None].astype(quaternions.dtype)


def _shifted(rows: Float64[np.ndarray, "N A"], offset: int, layout: Layout) -> Float64[np.ndarray, "N A"]:
    """Row t becomes row t - offset. Beyond the ends places and held dimensions stay as they are, steps are none."""
    wanted = np.arange(len(rows)) - offset
    places = np.clip(wanted, min(1, len(rows) - 1), len(rows) - 1)
    shifted = rows[places]
    if layout.kind == "delta":
        still = np.zeros(rows.shape[1])
        still[[first + 3 for first in layout.quaternions]] = 1
        held = np.isin(np.arange(rows.shape[1]), layout.held)
        shifted = np.where((wanted != places)[:, None] & ~held, still, shifted)
    return shifted


def _differences(rows: Float64[np.ndarray, "N A"], layout: Layout) -> Float64[np.ndarray, "N A"]:
    """Absolute rows as steps from the row before; quaternions as the rotation q₋₁⁻¹ q, in the hand's own frame."""
    steps = np.diff(rows, axis=0, prepend=rows[:1])
    before = np.concatenate([rows[:1], rows[:-1]])
    for first in layout.quaternions:
        part = slice(first, first + 4)
        turns = _product(_inverse(_unit(before[:, part])), _unit(rows[:, part]))
        steps[:, part] = np.where(turns[:, 3:] < 0, -turns, turns)  # the shorter way round
    for held in layout.held:
        steps[:, held] = rows[:, held]
    return steps


def _composed(
    rows: Float64[np.ndarray, "K A"], compose: Compose, layout: Layout, added: bool
) -> Float64[np.ndarray, " A2"]:
    """Args: added: whether rows are steps, which add up, rather than places."""
    if compose == "stack":
        return rows.reshape(-1)
    if compose == "last" or not added:
        return rows[-1]
    joined = rows.sum(0)
    for first in layout.quaternions:
        part = slice(first, first + 4)
        turn = _unit(rows[0, part])
        for row in rows[1:]:
            turn = _product(turn, _unit(row[part]))
        joined[part] = turn if turn[3] >= 0 else -turn  # the shorter way round
    for held in layout.held:
        joined[held] = rows[-1, held]
    return joined


def _unit(quaternion: Float64[np.ndarray, "*N 4"]) -> Float64[np.ndarray, "*N 4"]:
    """Of length 1; zeros, with which damaged data is filled, are no rotation."""
    length = np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return np.where(length > 0, quaternion / np.where(length > 0, length, 1), [0.0, 0.0, 0.0, 1.0])


def _inverse(quaternion: Float64[np.ndarray, "*N 4"]) -> Float64[np.ndarray, "*N 4"]:
    return quaternion * [-1.0, -1.0, -1.0, 1.0]


def _product(left: Float64[np.ndarray, "*N 4"], right: Float64[np.ndarray, "*N 4"]) -> Float64[np.ndarray, "*N 4"]:
    """Hamilton's, of x y z w."""
    vector_l, vector_r, w_l, w_r = left[..., :3], right[..., :3], left[..., 3:], right[..., 3:]
    vector = w_l * vector_r + w_r * vector_l + np.cross(vector_l, vector_r)
    return np.concatenate([vector, w_l * w_r - np.sum(vector_l * vector_r, -1, keepdims=True)], -1)
