"""Records policies as they act in the simulator: the source of the recipe ``recorded:PATH`` (docs/simulators.md).

Axes: T frames, A action dimensions.
"""

import shutil
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rsjax.config import SimConfig
from rsjax.data.build import write_clips
from rsjax.data.store import Store, open_store
from rsjax.progress import Progress
from rsjax.tools.policies.policy import Policy
from rsjax.tools.policies.worlds.simulator_world import SimulatorWorld
from rsjax.tools.sim.episode import clip_seed, source_name

FIRST_EPISODE = 60_000_000  # number of the first start; collected episodes have others


def record(policies: Mapping[str, Policy], world: SimulatorWorld, config: SimConfig, episodes: int, out: Path) -> Store:
    """Records ``episodes`` episodes of each policy, all from the same starts, and returns their store, ``out/KEY``.

    An episode has ``config.frames`` frames, whether or not it succeeds before. KEY is a hash of the episodes, so a path
    always means the same ones.

    Args:
        policies: by name.
        world: simulators with the settings of ``config``.
    """
    partial = out / "partial"
    store = write_clips(partial, _records(policies, world, config, episodes), test_share=0.0)
    place = out / str(store.manifest["key"])
    if place.exists():  # the same episodes, recorded before
        shutil.rmtree(partial)
    else:
        partial.rename(place)
    return open_store(place)


def _records(
    policies: Mapping[str, Policy], world: SimulatorWorld, config: SimConfig, episodes: int
) -> Iterator[dict[str, Any]]:
    starts = [{"seed": config.seed, "episode": FIRST_EPISODE + number} for number in range(episodes)]
    done = 0
    lifted = 0
    with Progress("record", len(policies) * episodes, "episodes") as progress:
        for name, policy in policies.items():
            for first in range(0, episodes, world.count):
                group = starts[first : first + world.count]
                for start, record in zip(group, _episodes(policy, world, config, group, first), strict=True):
                    origin = {"source": source_name(config), "policy": name, "start": start, "camera": config.camera}
                    about = {"episode": f"{name}-{start['episode']}", "control_steps": config.control_steps}
                    lifted += bool(record["success"][-1])
                    yield record | {"episode": about["episode"], "provenance": origin | about}
                done += len(group)
                progress.update(done, success=lifted)


def _episodes(
    policy: Policy, world: SimulatorWorld, config: SimConfig, starts: list[dict[str, int]], draws: int
) -> list[dict[str, np.ndarray]]:
    """Returns frames, depth, actions and success of episodes that run together, all of full length."""
    act = policy.actor(draws)
    states = [world.reset([clip_seed(start) for start in starts])]
    for _ in range(config.frames - 1):
        states.append(world.step(act(states[-1].observation)))
    return [
        {
            "rgb": np.stack([state.observation["rgb"][number] for state in states]),
            "depth": np.stack([state.observation["depth"][number] for state in states]),
            "actions": np.stack([state.actions[number] for state in states]),
            "success": np.array([state.success[number] for state in states]),
        }
        for number in range(len(starts))
    ]
