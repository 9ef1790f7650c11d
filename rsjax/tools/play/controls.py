"""The controls that a person can move: the numbers of a control, with names and limits.

Axes: D numbers of a control, k controls of a frame's action, A = k·D numbers.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Float, Float32

from rsjax.config import Config
from rsjax.data.normalization import Normalization
from rsjax.tools.play.messages import Refused
from rsjax.tools.policies.worlds.actions import action_range
from rsjax.tools.sim.panda import STEP, TURN

MOST = 1e9  # of a number in an action; far smaller ones are clipped already


@dataclass(frozen=True)
class Control:
    """One number of a control.

    Attributes:
        low, high: limits, in the recording's unit; numbers out of range are clipped.
        rest: the value that asks for no motion.
        kind: an axis returns to rest; a toggle stays at one of two values.
        unit, scale: the meaning of 1 in each control step; None if it is unknown.
    """

    name: str
    label: str
    low: float
    high: float
    rest: float
    kind: Literal["axis", "toggle"]
    unit: str
    scale: float | None


@dataclass(frozen=True)
class Controls:
    """The D numbers of a control, and how many times a frame's action repeats the control."""

    each: tuple[Control, ...]
    repeat: int

    @property
    def width(self) -> int:
        """A, the numbers of an action."""
        return len(self.each) * self.repeat

    def describe(self) -> dict[str, Any]:
        """Returns the description of the controls for a page."""
        return {"controls": [asdict(each) for each in self.each], "repeat": self.repeat, "action_dim": self.width}

    def action(self, numbers: Any) -> tuple[Float32[np.ndarray, " A"], int]:
        """Returns the action that D or A numbers stand for, within limits, and how many numbers were clipped.

        Raises:
            Refused: their count is neither D nor A, or they are not finite numbers.
        """
        if not isinstance(numbers, list | np.ndarray) or len(numbers) not in (len(self.each), self.width):
            counts = " or ".join(map(str, dict.fromkeys((len(self.each), self.width))))
            raise Refused("bad_action", f"an action is a list of {counts} numbers")
        if any(isinstance(number, bool) or not isinstance(number, int | float | np.number) for number in numbers):
            raise Refused("bad_action", "an action is of numbers alone")
        if not all(-MOST <= number <= MOST for number in numbers):  # nor is NaN
            raise Refused("bad_action", f"an action is of finite numbers, from -{MOST:g} to {MOST:g}")
        wanted = np.asarray(numbers, np.float32)
        wanted = np.tile(wanted, self.width // len(wanted))
        low, high = self.limits
        taken = np.clip(wanted, low, high)
        return taken, int((taken != wanted).sum())

    @property
    def limits(self) -> tuple[Float32[np.ndarray, " A"], Float32[np.ndarray, " A"]]:
        """The least and greatest actions."""
        ends = np.array([(each.low, each.high) for each in self.each], np.float32)
        return np.tile(ends[:, 0], self.repeat), np.tile(ends[:, 1], self.repeat)

    def random(self, rng: np.random.Generator) -> Float[np.ndarray, " A"]:
        """Returns the action of one random control: axes are uniform within the limits, toggles take either value."""
        numbers = [
            float(rng.choice([each.low, each.high])) if each.kind == "toggle" else rng.uniform(each.low, each.high)
            for each in self.each
        ]
        return np.tile(np.array(numbers, np.float32), self.repeat)


def controls_of_run(config: Config, normalization: Normalization, names: Sequence[str] = ()) -> Controls:
    """Returns the controls of a run: those of its simulator, or the dimensions of a recording's actions.

    Args:
        names: names of a recording's dimensions, such as "gripper (held)"; "(held)" for a dimension without a name.
    """
    if config.data is None:
        return Controls(_METAWORLD if config.sim.env == "metaworld" else _PANDA, config.sim.control_steps)
    limits = action_range(config, normalization)
    mean = normalization.action_mean
    each = []
    for number, (least, most) in enumerate(zip(limits.low.tolist(), limits.high.tolist(), strict=True)):
        if number < len(names):
            name = names[number]
        else:
            name = ""
        if not name or name.startswith("("):
            name = f"action {number} {name}".strip()
        if least < 0 < most:
            rest = 0.0
        else:
            rest = float(mean[number])
        each.append(Control(name, name, least, most, rest, "axis", "as recorded", None))
    return Controls(tuple(each), 1)


def _axis(name: str, label: str, unit: str, scale: float) -> Control:
    return Control(name, label, -1.0, 1.0, 0.0, "axis", unit, scale)


_GRIPPER = Control("gripper", "gripper: open, closed", -1.0, 1.0, -1.0, "toggle", "", None)
_PANDA = (
    _axis("x", "away from the robot's base, back", "metres", STEP),
    _axis("y", "left, right", "metres", STEP),
    _axis("z", "up, down", "metres", STEP),
    _axis("turn x", "turn about x", "radians", TURN),
    _axis("turn y", "turn about y", "radians", TURN),
    _axis("turn z", "turn about the vertical", "radians", TURN),
    _GRIPPER,
)
_METAWORLD = (
    _axis("x", "right, left", "metres", 0.01),
    _axis("y", "away from the robot's base, back", "metres", 0.01),
    _axis("z", "up, down", "metres", 0.01),
    _GRIPPER,
)
