"""Decides what each dimension of recorded actions is: a step, which adds up over skipped frames, or a target.

Axes: N recorded frames, A action dimensions.
"""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from rsjax.tools.ingest.actions import ActionConfig, Kind, Layout

_FEWEST = 16  # with fewer rows, staying away from zero means nothing
_NEAR = 0.1  # share of a dimension's largest value below which a value is near zero
_FOLLOWS = 0.5  # share of the state's standard deviation within which actions follow the state


class Declared(NamedTuple):
    """What a data set or its user declares about actions, as arguments of :func:`layout_of`; None: nothing."""

    kind: Kind | None
    held: tuple[int, ...] | None
    quaternions: tuple[int, ...]


def layout_of(
    actions: Float[np.ndarray, "N A"],
    kind: Kind | None,
    held: Sequence[int] | None,
    quaternions: Sequence[int] = (),
    names: Sequence[str] = (),
    states: Float[np.ndarray, "N S"] | None = None,
) -> Layout:
    """Builds the layout of an episode's actions from what its data set declares; notes which cannot be steps.

    Args:
        actions: aligned as in :class:`rsjax.tools.ingest.episode.Episode`.
        kind: as in :class:`rsjax.tools.ingest.actions.Layout`; None: not declared.
        held: likewise; None: not declared. If it is declared, no dimension is questioned.
        quaternions: likewise.
        names: names of the dimensions.
        states: the robot's measured states.
    """
    unclear: tuple[str, ...] = ()
    if kind != "absolute" and held is None:
        known = {first + place for first in quaternions for place in range(4)}
        named = list(names) if len(names) == actions.shape[1] else [""] * actions.shape[1]
        like = states[1:] if states is not None and states.shape == actions.shape else None
        unclear = tuple(_no_steps(actions[1:], known, named, like))
    return Layout(kind or "undeclared", tuple(quaternions), tuple(held or ()), unclear)


def _no_steps(
    rows: Float[np.ndarray, "N A"], known: set[int], names: Sequence[str], states: Float[np.ndarray, "N A"] | None
) -> Iterator[str]:
    """Yields each dimension that cannot be a step, with the reason.

    It has only two values, is a gripper, is never near zero, or follows the state.
    """
    for place, values in enumerate(rows.T):
        if place in known or not values.any():
            continue
        distinct, reach = np.unique(values), np.abs(values)
        why = ""
        if np.isin(distinct, (0, 1)).all() or np.isin(distinct, (-1, 1)).all():
            why = f"is never anything but {' or '.join(f'{value:g}' for value in distinct)}"
        elif "grip" in names[place].lower() and "delta" not in names[place].lower():
            why = "is a gripper"
        elif len(values) >= _FEWEST and values.min() * values.max() > 0 and reach.min() > _NEAR * reach.max():
            why = f"never comes near zero ({values.min():.3g} to {values.max():.3g})"
        elif states is not None and _follows(values, states[:, place]):
            why = "is nearly the state"
        if why:
            yield f"dimension {place}{f' ({names[place]})' if names[place] else ''} {why}"


def _follows(values: Float[np.ndarray, " N"], state: Float[np.ndarray, " N"]) -> bool:
    """Returns whether values roughly equal the state; real steps would be as far from the state as zero is."""
    return bool(np.sqrt(np.mean(np.square(values - state))) < _FOLLOWS * state.std())


def flat_names(names: Any, width: int) -> list[str]:
    """Returns a name for each dimension from lists or objects of names; [] if their number does not match.

    Args:
        names: as a data set stores them, such as LeRobot's ``{"motors": ["x", "y"]}``.
        width: how many dimensions there are.
    """
    if isinstance(names, dict):
        names = list(names) if all(isinstance(value, int) for value in names.values()) else list(names.values())
    while isinstance(names, list) and len(names) == 1 and isinstance(names[0], list):
        names = names[0]
    if not isinstance(names, list) or len(names) != width:
        return []
    return [str(name) for name in names]


def describe_dimensions(layout: Layout, names: Sequence[str], config: ActionConfig, width: int) -> list[str]:
    """Returns a line for each dimension of a clip's actions: its name, and what it is.

    Args:
        layout: layout of the recorded actions.
        names: names of their dimensions; "" or none: unknown.
        config: how they became the clip's actions.
        width: dimensions of the clip's actions; more than the recorded ones if rows were stacked.
    """
    turned = {first + place for first in layout.quaternions for place in range(4)}
    recorded = len(names) or width
    kind = "delta" if config.kind == "delta" else layout.kind
    lines = []
    for place in range(width):
        row, dimension = divmod(place, recorded)
        what = "held" if dimension in layout.held else f"{kind}, of a quaternion" if dimension in turned else kind
        stacked = f", row {row}" if width > recorded else ""
        lines.append(f"{names[dimension] if names else ''} ({what}{stacked})".strip())
    return lines
