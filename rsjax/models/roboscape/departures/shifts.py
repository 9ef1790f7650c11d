"""Moved copies of the training clips, so that few clips last longer.

A scene that is moved by less than a token has new tokens everywhere.

:func:`rsjax.tokenizers.tokenize.tokenize_store` makes the copies' tokens.
"""

import numpy as np

from rsjax.data.codec import Record
from rsjax.data.shift import moved_tracks


def drawn_copy(record: Record, rng: np.random.Generator) -> Record:
    """Returns a token record or one of its moved copies, drawn at random; the record itself if it has none."""
    if "shifts" not in record:
        return record
    number = rng.integers(len(record["shifts"]) + 1)
    if number == 0:
        return record
    tokens = {}
    for name in ("rgb", "depth"):
        copies = record[f"{name}_shifted"]
        tokens[name] = None if copies is None else copies[number - 1]
    return record | tokens | moved_tracks(record, record["shifts"][number - 1])
