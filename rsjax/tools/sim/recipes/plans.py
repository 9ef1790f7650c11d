"""The recipes by name, and the episodes that a mix of them consists of."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rsjax.config import SimConfig
from rsjax.config.sim import EXPERT, RECORDED
from rsjax.tools.sim.episode import EpisodePlan, Manner, task_of
from rsjax.tools.sim.recipes import driving, grasps, midway, novices, pushes, slips
from rsjax.tools.sim.recipes.recorded import recorded

HELD_OUT = 5_000_000  # added to the numbers of episodes that training never sees


@dataclass(frozen=True)
class Recipe:
    """A recipe.

    Attributes:
        draw: returns the manner of an episode, given a generator and the episode's place among those of the recipe.
        first: number of its first episode, which with the seed determines start and draws.
        group: how many successive episodes have one number, so that they share start and draws.
        lead: bounds of the frames that pass before a clip's first one.
        version: raise it when the same configuration gives different episodes.
    """

    draw: Callable[[np.random.Generator, int], Manner]
    first: int
    group: int = 1
    lead: tuple[int, int] = (0, 0)
    version: int = 1


RECIPES = {
    "grasps": Recipe(grasps.grasps, 10_000_000, grasps.GROUP, version=8),
    "pushes": Recipe(pushes.pushes, 20_000_000),
    "slips": Recipe(slips.slips, 30_000_000),
    "driving": Recipe(driving.driving, 40_000_000),
    "novices": Recipe(novices.novices, 50_000_000, version=3),
    "midway": Recipe(midway.midway, 60_000_000, lead=midway.LEAD, version=4),
}


def versions(config: SimConfig) -> tuple[Any, ...]:
    """Returns what the training episodes depend on beside the configuration; empty for the expert alone."""
    return tuple((name, RECIPES[name].version) for name in config.shares if name in RECIPES)


def training_plans(config: SimConfig) -> tuple[EpisodePlan, ...]:
    """Returns the episodes of the train split: the recipes take turns, so that any first part has their shares.

    Raises:
        UserError: a store of recorded episodes is missing, or does not fit the configuration.
    """
    made = dict.fromkeys(config.shares, 0)
    plans = []
    for number in range(config.episodes - config.test_episodes):
        owed = {name: share * (number + 1) - made[name] for name, share in config.shares.items()}
        recipe = max(owed, key=lambda name: owed[name])
        name = f"{number:06d}"
        if recipe == EXPERT:
            plan = EpisodePlan(name, number, task_of(config, number))
        elif recipe.startswith(RECORDED):
            plan = recorded(config, Path(recipe.removeprefix(RECORDED)), made[recipe], name)
        else:
            plan = scripted(config, recipe, made[recipe], name)
        plans.append(plan)
        made[recipe] += 1
    return tuple(plans)


def held_out_plans(config: SimConfig, recipe: str, count: int) -> tuple[EpisodePlan, ...]:
    """Returns ``count`` episodes of one recipe that no training sees."""
    return tuple(scripted(config, recipe, place, f"{recipe}-{place:06d}", HELD_OUT) for place in range(count))


def scripted(config: SimConfig, recipe: str, place: int, name: str, after: int = 0) -> EpisodePlan:
    """Returns the plan of a recipe's ``place``-th episode; ``after`` is added to its number."""
    entry = RECIPES[recipe]
    episode = entry.first + after + place // entry.group
    rng = np.random.default_rng([config.seed, episode, 5])
    manner = entry.draw(rng, place)
    return EpisodePlan(name, episode, manner=manner, lead=int(rng.integers(*entry.lead, endpoint=True)))
