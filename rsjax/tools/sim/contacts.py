"""Collects held-out clips of each recipe, in which position decides, for a store of Lift's clips.

The splits ``contacts_grasps``, ``contacts_pushes`` and so on hold episodes that no training sees, whatever the recipe
of the training clips.
"""

from rsjax.config import SimConfig, content_key
from rsjax.data.store import Store, open_store
from rsjax.tools.sim.collect import Collection, Report, collection_key, make_store
from rsjax.tools.sim.recipes.plans import RECIPES, held_out_plans
from rsjax.tools.sim.unseen import UNITS

FOLDER = "contacts"  # inside the store's directory, so that it moves with the store
PREFIX = "contacts_"  # of the splits' names


def collect_contacts(config: SimConfig, clips: Store, episodes: int, report: Report, workers: int = 0) -> Store:
    """Collects ``episodes`` clips for each split, unless they exist, and returns their store.

    Its splits are :func:`contact_splits`. It has the depth range and action statistics of ``clips``, so that a model
    reads both stores alike.

    Args:
        config: the configuration of ``clips``.
        clips: the store that training reads.
        report: called as episodes finish.
        workers: processes that simulate; 0: one per core.

    Raises:
        UserError: as :func:`rsjax.tools.sim.collect.collect`.
    """
    versions = tuple((name, recipe.version) for name, recipe in RECIPES.items())
    key = content_key(FOLDER, versions, collection_key(config), episodes)
    splits = {PREFIX + name: held_out_plans(config, name, episodes) for name in RECIPES}
    meta = {name: clips.manifest[name] for name in UNITS}
    out = clips.path / FOLDER / key
    make_store(Collection(key, config, splits, meta), out, report, workers)
    return open_store(out)


def contact_splits(config: SimConfig) -> tuple[str, ...]:
    """Returns the names of the splits of :func:`collect_contacts`; none in Meta-World."""
    if config.env != "lift":
        return ()
    return tuple(PREFIX + name for name in RECIPES)
