"""Which checkpoints are kept."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from orbax.checkpoint.checkpoint_managers import (
    AnyPreservationPolicy,
    EveryNSteps,
    LatestN,
    PolicyCheckpointInfo,
    PreservationContext,
    PreservationPolicy,
)


@dataclass
class Best(PreservationPolicy):
    """Keeps the checkpoint with the lowest metric, of equal ones the newest; none where none has a metric.

    Orbax's own BestN keeps the metrics where a damaged one stops it from opening the others.

    Attributes:
        metrics: each step's, where it has one.
    """

    metrics: Mapping[int, float]

    def should_preserve(
        self, checkpoints: Sequence[PolicyCheckpointInfo], *, context: PreservationContext
    ) -> Sequence[bool]:
        judged = [(self.metrics[info.step], -info.step) for info in checkpoints if info.step in self.metrics]
        best = -min(judged)[1] if judged else None
        return [info.step == best for info in checkpoints]


def retention(keep_last: int, keep_every: int, metrics: Mapping[int, float] | None) -> PreservationPolicy:
    """Keeps what any of three rules asks for.

    Args:
        keep_last: the newest checkpoints, this many.
        keep_every: every one at a multiple of this many steps; 0: none for that.
        metrics: the one with the lowest metric, by these; None: none for that.
    """
    policies: list[PreservationPolicy] = [LatestN(keep_last)]
    if keep_every:
        policies.append(EveryNSteps(keep_every))
    if metrics is not None:
        policies.append(Best(metrics))
    return AnyPreservationPolicy(policies)
