"""rsjax: a world model that robots can learn in.

>>> import rsjax
>>> model = rsjax.load("runs/tiny")
>>> clips = rsjax.open_store("data/lift-8957a85fdb4d61e6").source("test")
>>> video = model.generate(clips[0]["rgb"][:1], clips[0]["actions"])

``docs/api.md`` shows all of it.
"""

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rsjax.data.store import Store
    from rsjax.models.trained import TrainedModel

__version__ = "0.1.0"
__all__ = ["__version__", "load", "open_store"]


def load(run: "Path | str") -> "TrainedModel":
    """Loads the trained world model of a run directory, as ``experiments.train`` makes it.

    Args:
        run: the directory, such as ``"runs/tiny"``.

    Returns:
        A model whose ``generate``, ``plan``, ``encode`` and ``decode`` take and return numpy arrays.

    Raises:
        rsjax.errors.UserError: the run is missing, unfinished or damaged, or was made by another version of rsjax.
    """
    from rsjax.pipeline import trained  # jax is imported when it is needed, not with the package

    return trained.load(run)


def open_store(path: "Path | str") -> "Store":
    """Opens a store of clips, as ``experiments.train`` and ``experiments.ingest`` make them.

    Args:
        path: the store's directory.

    Returns:
        A store: ``store.splits`` names its splits, ``store.source("test")[0]`` is the first test clip, a dict with the
        fields of :class:`rsjax.clip.Clip`.

    Raises:
        rsjax.data.store.StoreError: the store is missing, incomplete or damaged.
    """
    from rsjax.data import store

    return store.open_store(path)
