"""Episodes of policies as they act in the simulator, recorded by ``rsjax record`` and simulated once more.

Only their starts and actions are used, so that frames, depth and tracks are those of the configuration at hand.
"""

from functools import cache
from pathlib import Path

from rsjax.config import SimConfig
from rsjax.data.codec import Record
from rsjax.data.store import MANIFEST, open_store
from rsjax.errors import UserError
from rsjax.files import file_versions
from rsjax.tools.sim.episode import POLICY, EpisodePlan, Replay, begins_episode


def recorded(config: SimConfig, store: Path, place: int, name: str) -> EpisodePlan:
    """Returns the plan that repeats the ``place``-th recorded episode; after the last one comes the first again.

    Raises:
        UserError: the store is missing, was not recorded from policies, or has shorter episodes or other actions.
    """
    episodes = _episodes(store, file_versions(store / MANIFEST))
    episode = episodes[place % len(episodes)]
    frames, width = episode["actions"].shape
    if frames < config.frames or width != config.action_dim:
        raise UserError(
            f"{store}: has episodes of {frames} frames and {width} numbers an action; sim.frames {config.frames} and "
            f"sim.control_steps {config.control_steps} need {config.frames} and {config.action_dim}: record longer ones"
        )
    origin = episode["provenance"]
    replay = Replay(episode["actions"], 0.0, origin["expert"])
    return EpisodePlan(name, origin["episode"], replay=replay, seed=origin["seed"])


@cache
def _episodes(store: Path, versions: tuple[tuple[int, ...], ...]) -> list[Record]:
    """Returns the actions and the provenance of the recorded episodes."""
    source = open_store(store).source("train")
    episodes: list[Record] = []
    for record in map(source.__getitem__, range(len(source))):
        manner = record["provenance"].get("expert")
        if not isinstance(manner, dict) or manner.get("mode") != POLICY:
            raise UserError(f"{store}: its clips are not of policies in the simulator; make it with rsjax record")
        if not begins_episode(record):
            raise UserError(
                f"{store}: its clips begin in the middle of episodes; name the store of whole ones beside it"
            )
        episodes.append({name: record[name] for name in ("actions", "provenance")})
    return episodes
