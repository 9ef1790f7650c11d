"""What the trained stages read: records by the config's stages, and only those that can be read."""

import hashlib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rsjax.config import LoopConfig
from rsjax.data.codec import Record
from rsjax.data.curriculum import Feed, plan
from rsjax.data.order import Transform
from rsjax.data.quarantine import NAME, Quarantine
from rsjax.data.store import Source, Store, StoreError
from rsjax.data.units import Units
from rsjax.pipeline import transforms
from rsjax.progress import note
from rsjax.train.distributed import is_lead


def planned(
    loop: LoopConfig, own: Store, transform: Callable[[Store], Transform], directory: Path
) -> tuple[LoopConfig, Feed]:
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
        integrate: whether the actions' sums follow them (see :meth:`rsjax.sample.generator.Units.action_inputs`).
        store: the one that is read.
    """
    units, there = Units.create(own), Units.create(store)
    if units.depth_range != there.depth_range and there.depth_range and is_lead():
        note(
            f"{store.path}: its depth tokens stand for {there.depth_range} m, this run's for {units.depth_range} m; "
            f"the model is not told"
        )
    return partial(transforms.token_clip, units, integrate)


def readable(source: Source, split: str, directory: Path, max_damaged: float) -> Iterator[Record]:
    """A split's clips, in order. A damaged one is listed and left out, but not of those that scores are made of.

    Args:
        directory: where the list is kept.
        max_damaged: share of the clips that may be left out.

    Raises:
        StoreError: too many are damaged, or one of another split than ``train``.
    """
    quarantine = Quarantine(directory / NAME, len(source), max_damaged)
    for index in range(len(source)):
        try:
            clip = source[index]
        except StoreError as error:
            if split != "train":
                raise
            quarantine.note(source.locate(index), error, instead="it is left out")
            continue
        yield clip


def fingerprint(params: Any) -> str:
    """16 hex digits of all weights: two tokenizers' tokens mean the same where these agree."""
    digest = hashlib.sha256()
    for leaf in jax.tree.leaves(params):
        digest.update(np.asarray(leaf).tobytes())
    return digest.hexdigest()[:16]
