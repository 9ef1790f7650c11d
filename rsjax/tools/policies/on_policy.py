"""Clips of what policies do in the simulator, successes and failures alike, for a world model to learn from.

A policy acts by its pictures, and what it did is simulated once more as a clip is, which gives exact depth and tracks.
Episodes are longer than clips, so they are cut into windows.

Axes: T frames, A action dimensions.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from rsjax.artifact import make_once
from rsjax.config import SimConfig, content_key
from rsjax.data.clips import first_clip
from rsjax.data.codec import Record, decode, encode
from rsjax.data.state_labels import knows_success, provenance_within
from rsjax.data.store import Store, complete_key, open_store, write_store
from rsjax.errors import UserError
from rsjax.files import write_file
from rsjax.progress import Progress
from rsjax.tools.policies.policy import Policy
from rsjax.tools.policies.worlds.world import World
from rsjax.tools.sim.collect import Collection, make_store
from rsjax.tools.sim.episode import POLICY, WINDOW, EpisodePlan, Replay, clip_seed
from rsjax.tools.sim.unseen import UNITS

FIRST_EPISODE = 2**20  # a run's own episodes have other numbers (sim/recipes/plans.py), so none starts like these
RECIPE = 2  # raise when the same episodes give other clips


def act(
    policy: Policy, world: World, seeds: Sequence[int], steps: int, folder: Path, name: str
) -> list[Float32[np.ndarray, "T A"]]:
    """Returns what a policy does in the simulator from each seed, for ``steps`` steps, also after it has succeeded.

    Args:
        world: the simulator.
        folder: keeps the actions of each group of episodes, so that an interrupted call resumes.
        name: for the progress line.

    Returns:
        The actions of each episode, with zeros in row 0, as in clips.
    """
    key = content_key("actions", RECIPE, policy.key, world.key, world.count, steps, str(list(seeds)))
    made: list[np.ndarray] = []
    with make_once(folder, key, refuse=None), Progress(name, len(seeds), "episodes") as progress:
        for first in range(0, len(seeds), world.count):
            file = folder / f"{first:05d}.actions"
            if not file.exists():
                actor = policy.actor(seeds[first] % 2**31)
                state = world.reset(seeds[first : first + world.count])
                rows = [state.actions]
                for _ in range(steps):
                    state = world.step(actor(state.observation))
                    rows.append(state.actions)
                write_file(file, encode({"actions": np.stack(rows, axis=1)}))
            made += list(decode(file.read_bytes())["actions"])
            progress.update(len(made))
    return made


def rollouts(
    policies: Mapping[str, Policy],
    world: World,
    config: SimConfig,
    episodes: Mapping[str, range],
    steps: int,
    folder: Path,
    name: str,
) -> Store:
    """Makes a store of whole episodes of policies in the simulator, ``folder/episodes``.

    An interrupted call resumes. The recipe ``recorded:PATH`` takes such a store (docs/simulators.md).

    Args:
        world: the simulator of ``config``.
        episodes: the numbers of the episodes of each split, from 0; the policies take turns.
        steps: of an episode.
        folder: the directory of the actions, and of the store.
        name: for the progress lines.
    """
    plans: dict[str, tuple[EpisodePlan, ...]] = {}
    for split, numbers in episodes.items():
        by_episode: dict[int, EpisodePlan] = {}
        for place, (policy_name, policy) in enumerate(policies.items()):
            episodes_of_policy = [FIRST_EPISODE + number for number in numbers[place :: len(policies)]]
            if not episodes_of_policy:
                continue
            seeds = [clip_seed({"seed": config.seed, "episode": episode}) for episode in episodes_of_policy]
            title = f"{name}: {policy_name} in the simulator, {split}"
            made = act(policy, world, seeds, steps, folder / "actions" / split / policy_name, title)
            for episode, actions in zip(episodes_of_policy, made, strict=True):
                manner = {"mode": POLICY, "policy": policy_name}
                replay = Replay(actions, 0.0, manner)
                by_episode[episode] = EpisodePlan(f"{split}-{episode:07d}", episode, replay=replay)
        plans[split] = tuple(by_episode[episode] for episode in sorted(by_episode))
    sim = replace(config, frames=steps + 1)
    keys = [policy.key for policy in policies.values()]
    key = content_key("on-policy episodes", RECIPE, sim, str(keys), str(dict(episodes)), world.count)
    total = sum(map(len, plans.values()))
    with Progress(f"{name}: with depth and tracks", total, "episodes") as progress:
        make_store(Collection(key, sim, plans, {}), folder / "episodes", lambda done, total: progress.update(done))
    return open_store(folder / "episodes")


def cut(episodes: Store, own: Store, frames: int, out: Path) -> Store:
    """Makes a store of the clips into which the episodes are cut, which a model reads as its own clips.

    Args:
        episodes: clips of at least as many frames.
        own: the clips that the model was trained on, whose ranges of depth and actions the new ones take over.
        frames: T of a clip.
        out: the directory of the store.

    Raises:
        UserError: the episodes are too short, or their pictures or actions have another size than the model's clips.
    """
    key = content_key("on-policy clips", 2, str(episodes.manifest.get("key")), str(own.manifest.get("key")), frames)
    if complete_key(out) == key:
        return open_store(out)
    like = first_clip(own)
    clips: dict[str, list[Record]] = {}
    for split in episodes.splits:
        source = episodes.source(split)
        for number in range(len(source)):
            record = source[number]
            check_alike(record, like, frames, episodes)
            clips.setdefault(split, []).extend(windows(record, frames))
    every = [clip for some in clips.values() for clip in some]
    inherited = (*UNITS, "source", "config", "depth_unit")
    meta: dict[str, Any] = {name: own.manifest[name] for name in inherited if name in own.manifest}
    meta |= {
        "key": key,
        "on_policy": {"episodes": episodes.manifest.get("key"), "path": str(episodes.path.absolute())},
        "tasks": sorted({clip["task"] for clip in every}),
    }
    if knows_success(episodes):
        meta["success_share"] = float(np.mean([clip["success"][-1] for clip in every]))
        meta["success_ever_share"] = float(np.mean([clip["success"].any() for clip in every]))
    write_store(out, "clips", clips, meta)
    return open_store(out)


def windows(record: Record, frames: int) -> list[Record]:
    """Returns the clips of ``frames`` frames that cover an episode: each begins where the one before it ends.

    The last one ends with the episode, and so may overlap more.
    """
    length = len(record["rgb"])
    firsts = sorted({*range(0, length - frames + 1, frames - 1), length - frames})
    clips = []
    for first in firsts:
        span = slice(first, first + frames)
        clip: Record = {}
        for name, value in record.items():
            if name in ("tracks", "visible"):
                value = value[:, span]
            elif isinstance(value, np.ndarray) and value.shape[:1] == (length,):
                value = value[span].copy()
            clip[name] = value
        clip["actions"][0] = 0  # nothing led into the first frame
        origin = provenance_within(record["provenance"], span)
        clips.append(clip | {"provenance": origin | {WINDOW: origin.get(WINDOW, 0) + first}})
    return clips


def check_alike(record: Record, like: Record, frames: int, episodes: Store) -> None:
    """Raises :class:`UserError` if an episode is too short, or differs in its sizes from one of the model's clips."""
    if len(record["rgb"]) < frames:
        raise UserError(
            f"{episodes.path}: an episode has {len(record['rgb'])} frames; the model's clips have {frames}, so record "
            f"longer ones"
        )
    sizes = [(clip["rgb"].shape[1], clip["actions"].shape[1], len(clip["tracks"])) for clip in (record, like)]
    units = [clip["provenance"].get("depth_unit", "metres") for clip in (record, like)]
    if sizes[0] != sizes[1] or units[0] != units[1]:
        raise UserError(
            f"{episodes.path}: pixels, numbers of an action, tracks and unit of depth are {(*sizes[0], units[0])}, "
            f"those of the model's clips {(*sizes[1], units[1])}; adapt to episodes that are recorded alike"
        )
