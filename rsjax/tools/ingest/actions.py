"""Turns recorded actions into the actions of a clip: the command that led from one *sampled* frame into the next.

An :class:`Episode` has a row of actions for each recorded frame, in its data set's units. A clip keeps about every
tenth frame; each of its actions combines the rows between two kept frames, in the way that :class:`ActionConfig`
chooses and :class:`ActionLayout` allows. :func:`layout_of` decides what each dimension is: a step, which adds up over
skipped frames, or a target.

Axes: N recorded frames, T sampled frames, K rows between two of these, A recorded and A' resulting action dimensions.
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float, Float32, Float64, Int

from rsjax.config.fields import ConfigError
from rsjax.tools.ingest.episode import EpisodeError

Kind = Literal["absolute", "delta"]
Compose = Literal["join", "last", "stack"]
_FEWEST = 16  # with fewer rows, staying away from zero means nothing
_NEAR = 0.1  # share of a dimension's largest value below which a value is near zero
_FOLLOWS = 0.5  # share of the state's standard deviation within which actions follow the state


@dataclass(frozen=True)
class ActionLayout:
    """The meaning of an action's numbers; readers store it in ``episode.meta["actions"]``.

    Attributes:
        kind: absolute: a target; delta: a change, or the step's velocity or torque; undeclared: the data set does not
            say.
        quaternions: first of the four dimensions of each unit quaternion, x y z w.
        held: dimensions whose command stays in force until the next one, such as open or closed for a gripper, whatever
            ``kind`` is. Differences of them are never taken, and of several commands the last one counts.
        unclear: dimensions that cannot be steps, each with the reason; empty if the data set declares what they are.
        angles: dimensions that are angles in radians, where π and -π are the same; quaternions are none.
    """

    kind: Kind | Literal["undeclared"] = "delta"
    quaternions: tuple[int, ...] = ()
    held: tuple[int, ...] = ()
    unclear: tuple[str, ...] = ()
    angles: tuple[int, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Returns the fields, JSON-ready; ``unclear`` and ``angles`` only if they are not empty."""
        values = {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(self).items()}
        return {name: value for name, value in values.items() if value or name not in ("unclear", "angles")}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> "ActionLayout":
        """Inverts :meth:`to_json`; missing fields get their defaults."""
        dims = (tuple(values.get(name, ())) for name in ("quaternions", "held", "unclear", "angles"))
        return cls(values.get("kind", "delta"), *dims)


@dataclass(frozen=True)
class ActionConfig:
    """The settings by which a source's actions become the actions of clips.

    Attributes:
        offset: frames by which this source recorded its commands too early (> 0) or too late (< 0), in addition to its
            format's documented alignment, which the reader undoes: row t becomes the one recorded at t - offset.
        compose: how the rows between two sampled frames become one. ``join``: one row of the same effect: deltas are
            added, quaternions multiplied, and the last absolute and held value counts. ``last``: the last row.
            ``stack``: all rows, one after the other (A' = K·A); the frames must be evenly spaced.
        kind: what the clip's actions are: ``recorded``, or ``delta`` of what was recorded as ``absolute``.
    """

    offset: int = field(default=0, metadata={"signed": True})
    compose: Compose = "join"
    kind: Literal["recorded", "absolute", "delta"] = "recorded"

    def __post_init__(self) -> None:
        for name, allowed in (("compose", get_args(Compose)), ("kind", ("recorded", "absolute", "delta"))):
            if getattr(self, name) not in allowed:
                raise ConfigError(f"actions.{name} is {getattr(self, name)!r}; choose one of {', '.join(allowed)}")


def check_layout(layout: ActionLayout, width: int, where: Path | str) -> None:
    """Raises :class:`EpisodeError` if a layout names dimensions that actions of this width do not have.

    Args:
        where: what the message names.
    """
    ends = [dim for first in layout.quaternions for dim in (first, first + 3)]
    for name, dims in (("held", layout.held), ("quaternions", ends), ("angles", layout.angles)):
        for wrong in (dim for dim in dims if not 0 <= dim < width):
            problem = f"{name} names dimension {wrong}, but actions have {width} (from 0 on)"
            raise EpisodeError.at(where, problem, f"mend the option {name}")


def check_declared(layout: ActionLayout, skipped: int, config: ActionConfig) -> None:
    """Raises :class:`EpisodeError` if it is not declared what must be known to make a clip's actions.

    Args:
        layout: layout of the recorded actions.
        skipped: largest number of recorded rows that one action of a clip combines.
        config: how these rows are combined.
    """
    needed = (skipped > 1 and config.compose == "join") or config.offset != 0 or config.kind != "recorded"
    if not needed or layout.kind == "absolute" or (layout.kind == "delta" and not layout.unclear):
        return
    doubts = "; ".join(layout.unclear)
    if layout.kind == "delta":
        problem = f"declared as steps, which add up, but {doubts}"
        cure = "say --option 'held=[…]' with the numbers of those that stay in force ('held=[]' if none does)"
        raise EpisodeError(f"actions: {problem}; {cure}", option="--option held")
    problem = f"{skipped} recorded rows become one, undeclared whether as steps, which add up, or as targets"
    cure = "say --option kind=delta or --option kind=absolute, and 'held=[…]' for grippers"
    if doubts:
        doubts = f"; these cannot be steps: {doubts}"
    raise EpisodeError(f"actions: {problem}; {cure}{doubts}", option="--option kind")


def align_actions(rows: Float[np.ndarray, "N A"], after: bool = False) -> Float32[np.ndarray, "N A"]:
    """Aligns each action with the frame into which it led.

    Args:
        rows: an action for each frame.
        after: whether each frame was recorded after the action of its row, so that rows stay where they are. Otherwise
            row t leads into frame t+1, row 0 becomes zeros, and the last row is dropped.
    """
    if after:
        return rows.astype(np.float32)
    aligned = np.zeros(rows.shape, np.float32)
    aligned[1:] = rows[:-1]
    return aligned


def sampled_actions(
    actions: Float32[np.ndarray, "N A"], frames: Int[np.ndarray, " T"], config: ActionConfig, layout: ActionLayout
) -> Float32[np.ndarray, "T A2"]:
    """Returns the action that led to each of these frames from the previous one in ``frames``; row 0 is zeros.

    Args:
        actions: an episode's actions; row t led into frame t; row 0 is zeros if it is unknown.
        frames: numbers of the sampled frames, increasing, each below N.
        config: how rows are combined.
        layout: layout of ``actions``.

    Raises:
        ConfigError: the configuration asks for absolute actions but the source records deltas, or for ``stack`` but the
            frames are unevenly spaced.
        EpisodeError: the layout names dimensions that the actions do not have, or the meaning of the actions has to be
            declared.
    """
    check_layout(layout, actions.shape[1], "meta.actions")
    if config.kind == "absolute" and layout.kind == "delta":
        raise ConfigError("actions.kind is 'absolute', but the source records deltas; say 'recorded' or 'delta'")
    gaps = np.diff(frames)
    if config.compose == "stack" and len(set(gaps.tolist())) > 1:
        raise ConfigError(f"actions.compose is 'stack', but frames are {gaps.min()} to {gaps.max()} apart; say 'join'")
    check_declared(layout, int(gaps.max(initial=1)), config)
    rows = _shifted(actions.astype(np.float64), config.offset, layout)
    differences = config.kind == "delta" and layout.kind == "absolute"
    if differences:
        rows = _differences(rows, layout)
    steps = differences or layout.kind == "delta"
    composed = [
        _composed(rows[before + 1 : after + 1], config.compose, layout, steps)
        for before, after in itertools.pairwise(frames)
    ]
    if composed:
        width = composed[0].size
    else:
        width = actions.shape[1]
    return np.stack([np.zeros(width), *composed]).astype(np.float32)


def continuous_signs(quaternions: Float[np.ndarray, "N 4"]) -> Float[np.ndarray, "N 4"]:
    """Returns the same rotations, each with the sign that is nearer to the previous one; q and -q are one rotation."""
    flips = np.sum(quaternions[1:] * quaternions[:-1], -1) < 0
    signs = np.concatenate([[1.0], np.where(np.cumsum(flips) % 2, -1.0, 1.0)])
    return quaternions * signs[: len(quaternions), None].astype(quaternions.dtype)


def _shifted(rows: Float64[np.ndarray, "N A"], offset: int, layout: ActionLayout) -> Float64[np.ndarray, "N A"]:
    """Moves row t - offset to row t. Beyond the ends, absolute and held values repeat and deltas mean no motion.

    The rows begin with row 1 if row 0 is zeros, which stand for an unknown action.
    """
    first = 0
    if not rows[0].any():
        first = min(1, len(rows) - 1)
    wanted = np.arange(len(rows)) - offset
    nearest = np.clip(wanted, first, len(rows) - 1)
    shifted = rows[nearest]
    if layout.kind == "delta":
        still = np.zeros(rows.shape[1])
        still[[first + 3 for first in layout.quaternions]] = 1
        is_held = np.isin(np.arange(rows.shape[1]), layout.held)
        shifted = np.where((wanted != nearest)[:, None] & ~is_held, still, shifted)
    return shifted


def _differences(rows: Float64[np.ndarray, "N A"], layout: ActionLayout) -> Float64[np.ndarray, "N A"]:
    """Turns absolute rows into steps from the previous row.

    Quaternions become q₋₁⁻¹ q, in the hand's own frame. Angles take the shorter way, across π if need be.
    """
    steps = np.diff(rows, axis=0, prepend=rows[:1])
    before = np.concatenate([rows[:1], rows[:-1]])
    for first in layout.quaternions:
        part = slice(first, first + 4)
        steps[:, part] = _shorter_way(_product(_unit(before[:, part]) * [-1.0, -1.0, -1.0, 1.0], _unit(rows[:, part])))
    for dimension in layout.angles:
        steps[:, dimension] = (steps[:, dimension] + np.pi) % (2 * np.pi) - np.pi
    for dimension in layout.held:
        steps[:, dimension] = rows[:, dimension]
    return steps


def _composed(
    rows: Float64[np.ndarray, "K A"], compose: Compose, layout: ActionLayout, steps: bool
) -> Float64[np.ndarray, " A2"]:
    """Combines rows into one.

    Args:
        steps: whether rows are steps, which add up, rather than absolute.
    """
    if compose == "stack":
        return rows.reshape(-1)
    if compose == "last" or not steps:
        return rows[-1]
    joined = rows.sum(0)
    for first in layout.quaternions:
        part = slice(first, first + 4)
        turn = _unit(rows[0, part])
        for row in rows[1:]:
            turn = _product(turn, _unit(row[part]))
        joined[part] = _shorter_way(turn)
    for dimension in layout.held:
        joined[dimension] = rows[-1, dimension]
    return joined


def _unit(quaternion: Float64[np.ndarray, "*N 4"]) -> Float64[np.ndarray, "*N 4"]:
    """Scales quaternions to length 1; zeros, which pad damaged data, become the identity."""
    length = np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return np.where(length > 0, quaternion / np.where(length > 0, length, 1), [0.0, 0.0, 0.0, 1.0])


def _shorter_way(turn: Float64[np.ndarray, "*N 4"]) -> Float64[np.ndarray, "*N 4"]:
    """Returns the same rotation with w ≥ 0: at most half a turn."""
    return np.where(turn[..., 3:] < 0, -turn, turn)


def _product(left: Float64[np.ndarray, "*N 4"], right: Float64[np.ndarray, "*N 4"]) -> Float64[np.ndarray, "*N 4"]:
    """Multiplies quaternions x y z w (Hamilton's product)."""
    vector_l = left[..., :3]
    vector_r = right[..., :3]
    w_l = left[..., 3:]
    w_r = right[..., 3:]
    vector = w_l * vector_r + w_r * vector_l + np.cross(vector_l, vector_r)
    return np.concatenate([vector, w_l * w_r - np.sum(vector_l * vector_r, -1, keepdims=True)], -1)


def described_layout(lines: Sequence[str]) -> ActionLayout | None:
    """Returns the layout of a store's actions from its lines of :func:`describe_dimensions`; None if there are none.

    Rows that were stacked count as dimensions of their own.
    """
    if not lines:
        return None
    kinds = described_kinds(lines)
    turned = [number for number, words in enumerate(kinds) if "of a quaternion" in words]
    moving = {words[0] for words in kinds} - {"held"}
    if not moving <= {"absolute", "delta"} or len(moving) > 1:
        return None
    held = tuple(number for number, words in enumerate(kinds) if words[0] == "held")
    angles = tuple(number for number, words in enumerate(kinds) if "an angle" in words)
    kind: Kind = "absolute"
    if "delta" in moving:
        kind = "delta"
    return ActionLayout(kind, tuple(turned[::4]), held, angles=angles)


def described_kinds(lines: Sequence[str]) -> list[list[str]]:
    """Returns what each line of :func:`describe_dimensions` says: the kind, and more such as "of a quaternion"."""
    return [line.rpartition("(")[2].removesuffix(")").split(", ") for line in lines]


class Declared(NamedTuple):
    """The declarations of a data set or its user about actions, as arguments of :func:`layout_of`; None: nothing."""

    kind: Kind | None
    held: tuple[int, ...] | None
    quaternions: tuple[int, ...]


def layout_of(
    actions: Float[np.ndarray, "N A"],
    kind: Kind | None,
    held: Sequence[int] | None,
    quaternions: Sequence[int] = (),
    angles: Sequence[int] = (),
    names: Sequence[str] = (),
    states: Float[np.ndarray, "N S"] | None = None,
) -> ActionLayout:
    """Builds the layout of an episode's actions from what its data set declares; notes which cannot be steps.

    Args:
        actions: aligned as in :class:`rsjax.tools.ingest.episode.Episode`.
        kind: as in :class:`rsjax.tools.ingest.actions.ActionLayout`; None: not declared.
        held: likewise; None: not declared. If it is declared, no dimension is questioned.
        quaternions: likewise.
        angles: likewise.
        names: names of the dimensions.
        states: the robot's measured states.
    """
    unclear: tuple[str, ...] = ()
    if kind != "absolute" and held is None:
        known = {first + place for first in quaternions for place in range(4)}
        if len(names) == actions.shape[1]:
            named = list(names)
        else:
            named = [""] * actions.shape[1]
        like = None
        if states is not None and states.shape == actions.shape:
            like = states[1:]
        unclear = tuple(_no_steps(actions[1:], known, named, like))
    return ActionLayout(kind or "undeclared", tuple(quaternions), tuple(held or ()), unclear, tuple(angles))


def _no_steps(
    rows: Float[np.ndarray, "N A"], known: set[int], names: Sequence[str], states: Float[np.ndarray, "N A"] | None
) -> Iterator[str]:
    """Yields each dimension that cannot be a step, with the reason.

    It has only two values, is a gripper, is never near zero, or follows the state.
    """
    for place, values in enumerate(rows.T):
        if place in known or not values.any():
            continue
        distinct = np.unique(values)
        reach = np.abs(values)
        why = ""
        if np.isin(distinct, (0, 1)).all() or np.isin(distinct, (-1, 1)).all():
            why = f"is never anything but {' or '.join(f'{value:g}' for value in distinct)}"
        elif "grip" in names[place].lower() and "delta" not in names[place].lower():
            why = "is a gripper"
        elif len(values) >= _FEWEST and values.min() * values.max() > 0 and reach.min() > _NEAR * reach.max():
            why = f"never comes near zero ({values.min():.3g} to {values.max():.3g})"
        elif states is not None:
            # Real steps would be as far from the state as zero is.
            state = states[:, place]
            if np.sqrt(np.mean(np.square(values - state))) < _FOLLOWS * state.std():
                why = "is nearly the state"
        if why:
            yield f"dimension {place}{f' ({names[place]})' if names[place] else ''} {why}"


def flat_names(names: Any, width: int) -> list[str]:
    """Returns a name for each dimension from lists or objects of names; [] if their number does not match.

    Args:
        names: as a data set stores them, such as LeRobot's ``{"motors": ["x", "y"]}``.
        width: how many dimensions there are.
    """
    if isinstance(names, dict):
        if all(isinstance(value, int) for value in names.values()):
            names = list(names)
        else:
            names = list(names.values())
    while isinstance(names, list) and len(names) == 1 and isinstance(names[0], list):
        names = names[0]
    if not isinstance(names, list) or len(names) != width:
        return []
    return [str(name) for name in names]


def describe_dimensions(layout: ActionLayout, names: Sequence[str], config: ActionConfig, width: int) -> list[str]:
    """Returns a line for each dimension of a clip's actions: its name, and what it is.

    Args:
        layout: layout of the recorded actions.
        names: a name for each of their dimensions, "" if it is unknown; none: names are unknown and no rows were
            stacked.
        config: how they became the clip's actions.
        width: dimensions of the clip's actions; more than the recorded ones if rows were stacked.
    """
    turned = {first + place for first in layout.quaternions for place in range(4)}
    recorded = len(names) or width
    if config.kind == "delta":
        kind = "delta"
    else:
        kind = layout.kind
    lines = []
    for place in range(width):
        row, dimension = divmod(place, recorded)
        if dimension in layout.held:
            what = "held"
        elif dimension in turned:
            what = f"{kind}, of a quaternion"
        elif dimension in layout.angles:
            what = f"{kind}, an angle"
        else:
            what = kind
        stacked = ""
        if width > recorded:
            stacked = f", row {row}"
        lines.append(f"{names[dimension] if names else ''} ({what}{stacked})".strip())
    return lines
