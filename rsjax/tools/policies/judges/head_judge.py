"""A judge that looks at no pictures: a world model's own success head, read while it generates.

Axes: B videos, T frames, n frames in a row.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from rsjax.config import ModelConfig
from rsjax.config.fields import require_range
from rsjax.data.state_labels import STATE
from rsjax.errors import UserError
from rsjax.files import read_json
from rsjax.models.trained import TrainedModel
from rsjax.tools.policies.judges.judge import FAIL, LABELS, SUCCESS, all_successes

NAME = "head"  # in place of a judge's directory: the model's own heads
FOLDER = "judge_head"  # in the run directory
VALIDATION = "validation.json"


@dataclass(frozen=True)
class HeadJudge:
    """Judges generated frames by the probability of success that the model's head read from their features.

    It never says "uninterpretable".

    Attributes:
        in_a_row: how many frames in a row must show success.
        validation: the content of its ``validation.json``, if it was validated.
    """

    in_a_row: int = 1
    validation: dict[str, Any] | None = None

    def __post_init__(self) -> None:
        require_range(self, "judge", 1, 16, "in_a_row")

    @property
    def key(self) -> str:
        """A name of all that verdicts depend on besides the model."""
        return f"{NAME}, {self.in_a_row} in a row"

    def read(self, state: Float[np.ndarray, "B T 3"]) -> Float[np.ndarray, "B 3"]:
        """Returns the probability of each of ``LABELS`` at the end of each video.

        Args:
            state: as of :class:`rsjax.clip.Video`, of at least ``in_a_row`` frames. Frames before a prompt's last have
                no reading (NaN) and show no success.
        """
        success = np.nan_to_num(state[:, -self.in_a_row :, STATE.index("success")])
        verdicts = np.zeros((self.in_a_row, len(success), len(LABELS)))
        verdicts[..., SUCCESS] = success.T
        verdicts[..., FAIL] = 1 - success.T
        return all_successes(verdicts)


def check_heads(model: ModelConfig, where: str) -> None:
    """Raises :class:`UserError` if a model has no state heads.

    Args:
        where: names the model in the message.
    """
    if getattr(model, "state_heads", None) is None:
        raise UserError(
            f"{where}: has no state heads, which the judge {NAME!r} reads; train it with --model.state-heads on, or "
            f"name another judge"
        )


def head_judge(trained: TrainedModel, run: Path | None = None) -> HeadJudge:
    """Returns the judge of a model's heads, with its validation if ``rsjax judge RUN --head`` made one.

    Raises:
        UserError: the model has no state heads, or the file of the validation is damaged.
    """
    check_heads(trained.config.model, "the model" if run is None else str(run))
    if run is None or not (run / FOLDER / VALIDATION).exists():
        return HeadJudge()
    return HeadJudge(frames_in_a_row(run), _validation(run))


def frames_in_a_row(run: Path) -> int:
    """Returns in how many frames in a row a run's head must read success: as many as ``rsjax judge RUN --head`` chose.

    Raises:
        UserError: the file of the validation is damaged.
    """
    if not (run / FOLDER / VALIDATION).exists():
        return HeadJudge().in_a_row
    return int(_validation(run).get("in_a_row", 1))


def _validation(run: Path) -> dict[str, Any]:
    return read_json(run / FOLDER / VALIDATION, cure="validate them again: rsjax judge RUN --head")
