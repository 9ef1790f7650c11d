"""Some training clips run backwards, with the actions that lead back, so that few clips show more motions.

In few recordings, a scene's first frame nearly says what the robot will do there, and a model memorises that
instead of following the actions. A clip that runs backwards begins where the other ends, and undoes its motion. Robots
move both ways; what falls or breaks does not, so this is for data in which the robot's own motion matters most.
"""

import numpy as np
from jaxtyping import Float

from rsjax.config import BackwardsConfig
from rsjax.data.codec import Record


def drawn_direction(settings: BackwardsConfig | None, record: Record, rng: np.random.Generator) -> Record:
    """Returns a token record, or with a chance of ``share`` the one of its frames in reverse order."""
    if settings is None or rng.random() >= settings.share:
        return record
    turned = {"actions": undoing(record["actions"], settings.held)}
    for name in ("rgb", "depth", "second"):
        if record.get(name) is not None:
            turned[name] = record[name][::-1]
    for name in ("tracks", "visible"):
        turned[name] = record[name][:, ::-1]
    return record | turned


def undoing(actions: Float[np.ndarray, "T A"], held: tuple[int, ...]) -> Float[np.ndarray, "T A"]:
    """Returns the actions of the frames in reverse order; row 0, which led into the first frame, is zeros.

    If a step a led from one frame into the next, -a leads back. What is held in frame t is so in that frame.

    Args:
        held: dimensions that are not steps.
    """
    back = np.zeros_like(actions)
    back[1:] = -actions[:0:-1]
    states = actions[:, held]
    states[0] = states[1]  # unknown, since row 0 has no meaning
    back[1:, held] = states[-2::-1]
    return back
