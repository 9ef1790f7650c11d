"""The action encoder also reads the sum of all actions so far: of pose deltas, that is the pose.

A large model finds it by temporal attention, a small one may not in few steps.
:meth:`rsjax.data.normalization.Normalization.action_inputs` appends the sums.
"""

from rsjax.config import Departures


def action_inputs(departures: Departures, action_dim: int) -> int:
    """Returns how many numbers per frame the action encoder reads."""
    if departures.integrate_actions:
        return 2 * action_dim
    return action_dim
