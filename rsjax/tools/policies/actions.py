"""Checks that a world model takes actions, and that the actions a policy sends to an environment are valid."""

from typing import Literal, TypeAlias, get_args

import numpy as np
from jaxtyping import Bool, Float, Float32

from rsjax.config.model import ModelConfig
from rsjax.errors import UserError

OutOfRange: TypeAlias = Literal["clip", "refuse"]


class ActionError(UserError):
    """An action of the wrong shape, with a value that is not finite, or out of range. The message says which."""


def check_out_of_range(value: str) -> None:
    """Raises :class:`UserError` unless the value is one of ``OutOfRange``."""
    if value not in get_args(OutOfRange):
        raise UserError(f"out_of_range is {value!r}; it is clip or refuse")


def check_takes_actions(model: ModelConfig, name: str = "the model") -> None:
    """Raises :class:`UserError` unless the model generates videos that depend on actions."""
    if not model.takes_actions:
        raise UserError(
            f"{name} takes no actions (family {model.family!r}), so its videos do not show what actions do; take a run "
            f"whose model does"
        )


def checked_actions(
    actions: object,
    low: Float[np.ndarray, "*B A"],
    high: Float[np.ndarray, "*B A"],
    out_of_range: OutOfRange,
    unit: str,
    ignored: Bool[np.ndarray, " B"] | None = None,
) -> tuple[Float32[np.ndarray, "*B A"], Bool[np.ndarray, "*B A"]]:
    """Returns actions as float32 within their range, and a mask of the numbers that were out of range.

    Args:
        actions: the policy's output.
        low: the least values; actions must have the same shape.
        high: the greatest values.
        out_of_range: "clip" clips numbers to the range, "refuse" raises an error.
        unit: the unit of the numbers, for error messages.
        ignored: rows that do not matter; they are replaced by the value in range that is closest to zero.

    Raises:
        ActionError: the shape or type is wrong, a value is not finite, or, with "refuse", a value is out of range.
    """
    try:
        given = np.asarray(actions, np.float32)
    except (TypeError, ValueError) as error:
        raise ActionError(
            f"an action is {type(actions).__name__}; expected floats of shape {low.shape}, {unit}"
        ) from error
    if given.shape != low.shape:
        raise ActionError(f"actions have shape {given.shape}; expected {low.shape}, {unit}")
    if ignored is not None:
        given = np.where(ignored[:, None], np.clip(0, low, high), given)
    if not np.isfinite(given).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(given))[0])
        raise ActionError(f"actions[{', '.join(map(str, where))}] is {given[where]}; expected finite numbers, {unit}")
    outside = (given < low) | (given > high)
    if outside.any() and out_of_range == "refuse":
        where = tuple(int(i) for i in np.argwhere(outside)[0])
        raise ActionError(
            f"actions[{', '.join(map(str, where))}] is {given[where]:g}; expected {low[where]:g} to {high[where]:g}, "
            f'{unit}; out_of_range="clip" clips and counts instead'
        )
    return np.clip(given, low, high), outside
