"""Damages records of stores."""

import numpy as np

from rsjax.data.store import Store, StoreError


def damage(store: Store, split: str, index: int) -> None:
    """Makes one record of a split unreadable and no other."""
    shard = store.path / f"{split}-00000.array_record"
    sound, count = shard.read_bytes(), len(store.source(split))
    for share in np.linspace(0.2, 0.8, 7):
        payload = bytearray(sound)
        payload[int(len(sound) * (index + share) / count)] ^= 255
        shard.write_bytes(bytes(payload))
        if [number for number in range(count) if not _readable(store, split, number)] == [index]:
            return
    raise AssertionError("no byte found")


def _readable(store: Store, split: str, index: int) -> bool:
    try:
        return bool(store.source(split)[index])
    except StoreError:
        return False
