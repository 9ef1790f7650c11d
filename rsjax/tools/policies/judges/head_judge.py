"""A judge that looks at no pictures: a world model's own success head, read while it generates.

Axes: B videos, T frames, n frames in a row.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.special import expit, logit

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
        shift: added to the logit of success (:func:`matching_shift`).
    """

    in_a_row: int = 1
    validation: dict[str, Any] | None = None
    shift: float = 0.0

    def __post_init__(self) -> None:
        require_range(self, "judge", 1, 16, "in_a_row")

    @property
    def key(self) -> str:
        """A name of all that verdicts depend on besides the model."""
        shifted = f", logits {self.shift:+g}" if self.shift else ""
        return f"{NAME}, {self.in_a_row} in a row{shifted}"

    def read(self, state: Float[np.ndarray, "B T 3"]) -> Float[np.ndarray, "B 3"]:
        """Returns the probability of each of ``LABELS`` at the end of each video.

        Args:
            state: as of :class:`rsjax.clip.Video`; of fewer frames than ``in_a_row``, all must show success. Frames
                before a prompt's last have no reading (NaN) and show no success.
        """
        success = np.nan_to_num(state[:, -self.in_a_row :, STATE.index("success")])
        if self.shift:
            success = expit(logit(success) + self.shift)
        verdicts = np.zeros((*success.T.shape, len(LABELS)))
        verdicts[..., SUCCESS] = success.T
        verdicts[..., FAIL] = 1 - success.T
        return all_successes(verdicts)


def likeliest(state: Float[np.ndarray, "B T 3"], in_a_row: int) -> Float[np.ndarray, " B"]:
    """Returns each video's largest probability of success, the least of ``in_a_row`` frames each time.

    Args:
        state: as of :class:`rsjax.clip.Video`, of generated frames.
    """
    judge = HeadJudge(in_a_row)
    return np.max([judge.read(state[:, : t + 1])[:, SUCCESS] for t in range(state.shape[1])], axis=0)


def matching_shift(likely: Float[np.ndarray, " B"], success: Bool[np.ndarray, " B"]) -> float:
    """Returns the shift of the logit of success with which the head calls as many videos a success as truly are one.

    Args:
        likely: the :func:`likeliest` probabilities of generated videos.
        success: what the simulator says of the same videos.
    """
    logits = np.sort(logit(np.clip(likely, 1e-6, 1 - 1e-6)))[::-1]
    true = int(success.sum())
    edges = np.concatenate([[logits[0] + 1], logits, [logits[-1] - 1]])
    return -float(edges[true : true + 2].mean())


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
    return replace(head_rule(run), validation=_validation(run))


def head_rule(run: Path) -> HeadJudge:
    """Returns the rule by which a run's head decides, without a validation: as ``rsjax judge RUN --head`` chose it.

    Raises:
        UserError: the file of the validation is damaged.
    """
    if not (run / FOLDER / VALIDATION).exists():
        return HeadJudge()
    validation = _validation(run)
    return HeadJudge(int(validation.get("in_a_row", 1)), shift=float(validation.get("shift", 0.0)))


def _validation(run: Path) -> dict[str, Any]:
    return read_json(run / FOLDER / VALIDATION, cure="validate them again: rsjax judge RUN --head")
