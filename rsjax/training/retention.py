"""Which checkpoints are kept."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from orbax.checkpoint import checkpoint_managers as ocm


@dataclass
class Best(ocm.PreservationPolicy):
    """Keeps the checkpoint with the lowest metric, the newest of equal ones; keeps none if none has a metric.

    Orbax's BestN reads the metrics from the checkpoints, where a damaged one stops it from opening the others.

    Attributes:
        metrics: by step.
    """

    metrics: Mapping[int, float]

    def should_preserve(
        self, checkpoints: Sequence[ocm.PolicyCheckpointInfo], *, context: ocm.PreservationContext
    ) -> list[bool]:
        judged = [(self.metrics[info.step], -info.step) for info in checkpoints if info.step in self.metrics]
        best = -min(judged)[1] if judged else None
        return [info.step == best for info in checkpoints]


def retention(keep_last: int, keep_every: int, metrics: Mapping[int, float] | None) -> ocm.PreservationPolicy:
    """Returns the policy that keeps every checkpoint to which one of three rules applies.

    Args:
        keep_last: number of newest checkpoints to keep.
        keep_every: keep those whose step is a multiple of this; 0: no such rule.
        metrics: keep the one with the lowest of these, by step; None: no such rule.
    """
    policies: list[ocm.PreservationPolicy] = [ocm.LatestN(keep_last)]
    if keep_every:
        policies.append(ocm.EveryNSteps(keep_every))
    if metrics is not None:
        policies.append(Best(metrics))
    return ocm.AnyPreservationPolicy(policies)
