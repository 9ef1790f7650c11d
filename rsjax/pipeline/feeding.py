"""What the trained stages read: records by the config's stages, and only those that can be read."""

import hashlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rsjax.config import LoopConfig
from rsjax.data.curriculum import LoaderFactory, plan
from rsjax.data.normalization import Normalization
from rsjax.data.order import Transform
from rsjax.data.store import Store
from rsjax.pipeline import transforms
from rsjax.progress import note
from rsjax.training.distributed import is_lead


def planned(
    loop: LoopConfig, own: Store, transform: Callable[[Store], Transform], directory: Path
) -> tuple[LoopConfig, LoaderFactory]:
    """:func:`rsjax.data.curriculum.plan`, and what it made of the stages is told."""
    loop, feed = plan(loop, own, transform, directory)
    if is_lead():
        for line in feed.summary():
            note(line)
    return loop, feed


def token_transform(own: Store, integrate: bool, store: Store) -> Transform:
    """How a store's token records become arrays beside those of ``own``: with actions in the same units.

    Args:
        own: the store of the model's own data.
        integrate: whether to append the actions' sums (:meth:`rsjax.data.normalization.Normalization.action_inputs`).
        store: the one that is read.
    """
    units = Normalization.create(own)
    here, there = _depth_told(own), _depth_told(store)
    if there and here != there and is_lead():
        note(f"{store.path}: its depth tokens stand for {there}, this run's for {here}; the model is not told")
    return partial(transforms.token_clip, units, integrate)


def _depth_told(store: Store) -> str:
    """What a store's depth tokens stand for; empty where no clip has depth."""
    near_far = store.manifest.get("depth_range")
    return f"{near_far[0]:g} to {near_far[1]:g} {store.manifest.get('depth_unit') or 'metres'}" if near_far else ""


def fingerprint(params: Any) -> str:
    """16 hex digits of all weights: two tokenizers' tokens mean the same where these agree."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(params):
        digest.update(np.asarray(leaf).tobytes())
    return digest.hexdigest()[:16]
