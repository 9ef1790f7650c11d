"""Checks that a world model takes actions, and that the actions a policy sends to a world are valid."""

from dataclasses import dataclass
from typing import Literal, TypeAlias, get_args

import numpy as np
from jaxtyping import Bool, Float32

from rsjax.config import Config
from rsjax.config.model import ModelConfig
from rsjax.data.normalization import Normalization
from rsjax.errors import UserError
from rsjax.models.trained import ShapeError, as_array

OutOfRange: TypeAlias = Literal["clip", "refuse"]
SPREAD = 5.0  # actions of recordings are clipped to this many standard deviations around the mean
PANDA_UNIT = "6-D change of the goal pose and gripper (+1 closes) for each control step, from -1 to 1"


class ActionError(UserError):
    """An action of the wrong shape, with a value that is not finite, or out of range. The message says which."""


def check_out_of_range(value: object) -> None:
    """Raises :class:`UserError` unless the value is one of ``OutOfRange``."""
    if not isinstance(value, str) or value not in get_args(OutOfRange):
        raise UserError(f"out_of_range is {value!r:.80}; it is clip or refuse")


def check_takes_actions(model: ModelConfig, name: str = "the model") -> None:
    """Raises :class:`UserError` unless the model generates videos that depend on actions."""
    if not model.takes_actions:
        raise UserError(
            f"{name} takes no actions (family {model.family!r}), so its videos do not show what actions do; take a run "
            f"whose model does"
        )


def check_world_model(config: Config, name: str) -> None:
    """Checks that policies can act in a run's model.

    Args:
        name: of the model.

    Raises:
        UserError: it takes no actions, or reads a second view, which episodes of policies do not have.
    """
    check_takes_actions(config.model, name)
    if config.second_view:
        raise UserError(
            f"{name} reads a second view (sim.second_view), which episodes of policies do not have; take a run without "
            f"it"
        )


@dataclass(frozen=True)
class ActionRange:
    """The actions that a world takes.

    Attributes:
        low: the least value of each number.
        high: the greatest value of each number.
        unit: the unit of the numbers, for error messages.
    """

    low: Float32[np.ndarray, " A"]
    high: Float32[np.ndarray, " A"]
    unit: str

    def clip(
        self,
        actions: object,
        count: int | None,
        out_of_range: OutOfRange = "clip",
        ignored: Bool[np.ndarray, " B"] | None = None,
    ) -> tuple[Float32[np.ndarray, "*B A"], Bool[np.ndarray, "*B A"]]:
        """Returns actions as float32 within the range, and a mask of the numbers that were out of range.

        Args:
            actions: the policy's output, (B, A), or (A,) for a single episode.
            count: B; None for a single episode.
            out_of_range: "clip" clips numbers to the range, "refuse" raises an error.
            ignored: rows that do not matter; they are replaced by the value in range that is closest to zero.

        Raises:
            ActionError: the shape or type is wrong, a value is not finite, or, with "refuse", a value is out of range.
        """
        if count is None:
            shape = self.low.shape
        else:
            shape = (count, *self.low.shape)
        wanted = f"expected floats of shape {shape}, {self.unit}"
        try:
            numbers = as_array("actions", actions)
        except ShapeError as error:
            raise ActionError(f"{error}; {wanted}") from error
        if numbers.dtype.kind not in "fiu":
            raise ActionError(f"an action is {type(actions).__name__} of {numbers.dtype}; {wanted}")
        with np.errstate(over="ignore"):  # what float32 cannot hold becomes infinite, which is refused below
            numbers = numbers.astype(np.float32)
        if numbers.shape != shape:
            raise ActionError(f"actions have shape {numbers.shape}; expected {shape}, {self.unit}")
        if ignored is not None:
            rest = np.clip(np.float32(0), self.low, self.high)
            numbers = np.where(ignored[:, None], rest, numbers)
        infinite = ~np.isfinite(numbers)
        if infinite.any():
            place = tuple(np.argwhere(infinite)[0].tolist())
            raise ActionError(
                f"actions[{', '.join(map(str, place))}] is {numbers[place]}; expected finite numbers, {self.unit}"
            )
        outside = (numbers < self.low) | (numbers > self.high)
        if outside.any() and out_of_range == "refuse":
            place = tuple(np.argwhere(outside)[0].tolist())
            low = self.low[place[-1]]
            high = self.high[place[-1]]
            raise ActionError(
                f"actions[{', '.join(map(str, place))}] is {numbers[place]:g}; expected {low:g} to {high:g}, "
                f'{self.unit}; out_of_range="clip" clips and counts instead'
            )
        return np.clip(numbers, self.low, self.high), outside


def action_range(config: Config, normalization: Normalization) -> ActionRange:
    """Returns the range of a run's actions.

    Actions in the simulator range from -1 to 1. For recordings, a run knows only the actions' mean and standard
    deviation; their range is the mean ± ``SPREAD`` standard deviations.
    """
    width = config.clips.action_dim
    if config.data is not None:
        mean = np.array(normalization.action_mean)
        std = np.maximum(normalization.action_std, 1e-3)
        low = (mean - SPREAD * std).astype(np.float32)
        high = (mean + SPREAD * std).astype(np.float32)
        return ActionRange(low, high, "in the recording's units, as the clips' actions")
    if config.sim.env == "metaworld":
        unit = "controls of the simulator, from -1 to 1"
    else:
        unit = PANDA_UNIT
    return ActionRange(np.full(width, -1, np.float32), np.full(width, 1, np.float32), unit)
