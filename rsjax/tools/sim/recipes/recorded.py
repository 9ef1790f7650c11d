"""Episodes of policies as they act in the simulator, recorded by ``rsjax record`` and simulated once more.

Only their starts and actions are used, so that frames, depth and tracks are those of the configuration at hand.
"""

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from rsjax.config import SimConfig
from rsjax.data.store import open_store
from rsjax.errors import UserError
from rsjax.tools.sim.episode import POLICY, EpisodePlan
from rsjax.tools.sim.expert import State


@dataclass(frozen=True)
class Recorded:
    """The manner of a recorded episode.

    Attributes:
        policy: name of the policy that acted.
        store: path of the store of recorded episodes.
        place: of the episode in that store.
    """

    mode: str
    policy: str
    store: str
    place: int

    def expert(self, rng: np.random.Generator) -> "Repeated":
        """Returns a policy that repeats the recorded actions; there is nothing to draw."""
        return Repeated(self, _episodes(Path(self.store))[self.place].actions)


class Repeated:
    """Repeats recorded actions, whatever the state.

    Args:
        actions: (T, A); row 0 led into no frame and is left out.
    """

    def __init__(self, manner: Recorded, actions: Float[np.ndarray, "T A"]) -> None:
        self.manner = manner
        self._controls = iter(actions[1:].reshape(-1, 7))

    def act(self, state: State) -> Float[np.ndarray, " 7"]:
        """Returns the next action."""
        return next(self._controls)


@dataclass(frozen=True, eq=False)
class Episode:
    """What is used of a recorded episode.

    Attributes:
        seed, episode: they determine the start.
        policy: name of the policy that acted.
        actions: as in a clip.
    """

    seed: int
    episode: int
    policy: str
    actions: Float32[np.ndarray, "T A"]


def recorded(config: SimConfig, store: Path, place: int, name: str) -> EpisodePlan:
    """Returns the plan that repeats the ``place``-th recorded episode; after the last one comes the first again.

    Raises:
        UserError: the store is missing, was not recorded from policies, or has shorter episodes or other actions.
    """
    episodes = _episodes(store)
    place = place % len(episodes)
    chosen = episodes[place]
    frames, width = chosen.actions.shape
    if frames < config.frames or width != config.action_dim:
        raise UserError(
            f"{store}: has episodes of {frames} frames and {width} numbers an action; sim.frames {config.frames} and "
            f"sim.control_steps {config.control_steps} need {config.frames} and {config.action_dim}: record longer ones"
        )
    manner = Recorded("recorded", chosen.policy, str(store), place)
    return EpisodePlan(name, chosen.episode, manner=manner, seed=chosen.seed)


@cache
def _episodes(store: Path) -> list[Episode]:
    source = open_store(store).source("train")
    episodes = []
    for record in map(source.__getitem__, range(len(source))):
        origin = record["provenance"]
        manner = origin.get("expert")
        if not isinstance(manner, dict) or manner.get("mode") != POLICY:
            raise UserError(f"{store}: its clips are not of policies in the simulator; make it with rsjax record")
        episodes.append(Episode(origin["seed"], origin["episode"], manner["policy"], record["actions"]))
    return episodes
